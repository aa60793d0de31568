"""`tdanet`, from a clone."""

from __future__ import annotations

from tdanet_jax.__main__ import main

if __name__ == "__main__":
    main()
