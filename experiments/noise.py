"""`tdanet noise`, from a clone."""

from __future__ import annotations

from tdanet_jax.commands.noise import main

if __name__ == "__main__":
    main()
