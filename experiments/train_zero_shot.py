"""`tdanet train`, from a clone."""

from __future__ import annotations

from tdanet_jax.commands.train_zero_shot import main

if __name__ == "__main__":
    main()
