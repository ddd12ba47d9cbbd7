#!/usr/bin/env bash
# jax.numpy.tanh in float32 is exactly 1 from u = 7.9988 on; the nearest float32 is below 1 up to u = 9.01.
#
# Expected: float32 tanh is good to an ulp or two, so it becomes 1 where the rounded value does, near u = 9.01.
# Seen:     on the CPU it jumps by 4 ulps (of 2^-24) to 1 at u = 7.9988. arctanh of the action is then infinite, and
#           the log-probability of a policy's own sample is NaN. Through u itself it is an ordinary number.
# Versions: jax and jaxlib 0.10.2; numpy 2.4.6; CPython 3.11, x86-64 Linux. Seen on 2026-11-29.
# Matters:  the stochastic policy of an online decision transformer is a squashed Gaussian, and actions of D4RL's
#           locomotion sets near +1 and -1 draw its mean outwards. A port that gets u back by arctanh(action) loses
#           the entropy, and with it the temperature's step, to NaN a whole unit of u before the format demands it.
# Way out:  keep u beside the action, or bound the action away from 1 before arctanh.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile jax==0.10.2 jaxlib==0.10.2 numpy==2.4.6

JAX_PLATFORMS=cpu "$folder/venv/bin/python" - <<'PYTHON'
import math
import sys
import jax
import jax.numpy as jnp
import jaxlib
import numpy as np

print(f"jax {jax.__version__}, jaxlib {jaxlib.__version__}, numpy {np.__version__}, on {jax.default_backend()}")


def first_one(function, low, high):
    """The smallest float32 between low and high at which the function is 1 from there on."""
    bits = np.arange(np.float32(low).view(np.uint32), np.float32(high).view(np.uint32), dtype=np.uint32)
    u = bits.view(np.float32)
    below = np.flatnonzero(function(u) < 1)
    return u[below[-1] + 1]


def nearest(u):
    """float32 tanh, rounded from float64."""
    return np.tanh(u.astype(np.float64)).astype(np.float32)


jax_one = first_one(lambda u: np.asarray(jnp.tanh(u)), 7.9, 9.2)
jit_one = first_one(lambda u: np.asarray(jax.jit(jnp.tanh)(u)), 7.9, 9.2)
true_one = first_one(nearest, 7.9, 9.2)
print(f"tanh(u) is 1 from u = {jax_one:.5f} (jnp), {jit_one:.5f} (jit), {true_one:.5f} (nearest float32)")
if not (7.99 < jax_one < 8.01 and jax_one == jit_one and 9.0 < true_one < 9.02):
    sys.exit("The behaviour changed: 7.9988 and 9.01 were expected.")


def log_density(u, mean, deviation):
    return -0.5 * ((u - mean) / deviation) ** 2 - jnp.log(deviation) - 0.5 * math.log(2 * math.pi)


mean, deviation = jnp.float32(8.0), jnp.float32(0.5)
print("u      2^24 (1 - tanh u): jnp, nearest   log-probability: through u, through jnp.tanh(u), through nearest")
for value in (7.5, 8.0, 8.25, 8.5, 8.75, 9.0):
    u = jnp.float32(value)
    action = jnp.tanh(u)
    best = jnp.asarray(nearest(np.float32(value)))
    # log(1 - tanh(u)^2) without cancellation.
    log_slope = 2 * (math.log(2) - u - jnp.log1p(jnp.exp(-2 * u)))
    through_u = log_density(u, mean, deviation) - log_slope
    through_action = log_density(jnp.arctanh(action), mean, deviation) - jnp.log1p(-action * action)
    through_best = log_density(jnp.arctanh(best), mean, deviation) - jnp.log1p(-best * best)
    missing = [2**24 * (1 - float(a)) for a in (action, best)]
    densities = ", ".join(f"{float(x):.3f}" for x in (through_u, through_action, through_best))
    print(f"{value:.2f}   {missing[0]:.0f}, {missing[1]:.0f}   {densities}")
    if not (math.isfinite(through_u) and math.isfinite(through_best) and missing[1] > 0):
        sys.exit("The behaviour changed: finite values were expected through u and of the nearest float32.")
    if math.isnan(through_action) != (value >= 8.0):
        sys.exit("The behaviour changed: NaN was expected through the action from u = 8 on.")
PYTHON
echo "Confirmed: float32 jnp.tanh is 1 a whole unit early, and the log-probability through the action is NaN there."
