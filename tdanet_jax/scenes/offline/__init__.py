"""The original offline data (the layout of SAVN, MJOLNIR and SSNet), in and out."""
