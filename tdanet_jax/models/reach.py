"""Whether the target is within reach, estimated without knowing what it is.

An agent learns how large a class looks where a `Done` succeeds, and misjudges classes that it was
never trained to find: many of its failures on them are a `Done` too far away. Triangulation tells
where the target seems to be, how large it is and how certain that is. From these numbers alone, two
hidden layers estimate how probable it is that the target in view is within reach. They are trained
with the agent, on what is within reach in the training rooms; as no name enters, the estimate
holds for other classes as well.

In training nothing is forbidden, so that the agent keeps a judgement of its own; after training,
both must agree.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn

from tdanet_jax.models.layers import Linear
from tdanet_jax.vocabulary import OUT_OF_REACH, Action

#: Units of each hidden layer.
UNITS = 64
#: The estimate's weight in the loss. The size of Adam's steps does not depend on it, for nothing
#: else trains these parameters; but gradients are clipped together, where it should count little.
WEIGHT = 0.1


class ReachEstimate(nn.Module):
    """From the reading of triangulation to the estimate's logit."""

    def setup(self) -> None:
        self.linear1 = Linear(UNITS)
        self.linear2 = Linear(UNITS)
        self.linear3 = Linear(1)

    def __call__(self, reading: jax.Array) -> jax.Array:
        """[..., 9] -> [...]."""
        return self.linear3(nn.relu(self.linear2(nn.relu(self.linear1(reading)))))[..., 0]


def mask_done(
    logits: jax.Array, reach_logit: jax.Array, in_view: jax.Array, threshold: float
) -> jax.Array:
    """The logits [..., 6] without `Done` where the target is not in view or probably out of reach.

    Args:
      logits: of the actions.
      reach_logit: [...], of the target being within reach.
      in_view: [...] bool, whether the target is in view.
      threshold: the least probability of reach with which `Done` is allowed.
    """
    allowed = in_view & (jax.nn.sigmoid(reach_logit) >= threshold)
    done = jnp.where(allowed, logits[..., Action.DONE], OUT_OF_REACH)
    return logits.at[..., Action.DONE].set(done)
