"""Files: written whole or not at all, bundled ones verified, foreign ones parsed with care."""
