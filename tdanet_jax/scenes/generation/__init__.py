"""Rooms that are generated: models of furniture, plans, and putting one into the other."""
