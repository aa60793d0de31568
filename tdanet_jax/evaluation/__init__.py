"""Policies on fixed episodes, metrics, and reports."""
