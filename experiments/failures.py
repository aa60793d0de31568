"""`tdanet failures`, from a clone."""

from __future__ import annotations

from tdanet_jax.commands.failures import main

if __name__ == "__main__":
    main()
