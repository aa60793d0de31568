"""Checks of rooms: agreement with AI2-THOR, and a survey before training."""
