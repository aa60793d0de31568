"""Looking at agents and rooms: traces, attention, replays and figures."""
