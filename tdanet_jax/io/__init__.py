"""Atomic writes, verified bundled data, and safe parsers for untrusted files."""
