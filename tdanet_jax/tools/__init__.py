"""Benchmarks, and the script that builds the bundled files."""
