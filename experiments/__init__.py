"""The commands by their names in a clone: `python -m experiments.NAME`.

They are in `tdanet_jax/commands/`; an installed package has `tdanet NAME` alone.
"""

from __future__ import annotations

import sys

from tdanet_jax import commands

if sys.argv[0] == "-m":
    commands.begin()
