"""`tdanet export`, from a clone."""

from __future__ import annotations

from tdanet_jax.commands.export import main

if __name__ == "__main__":
    main()
