"""Checks of rooms: agreement with AI2-THOR, consistency, and a survey before training."""
