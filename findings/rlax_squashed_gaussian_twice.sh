#!/usr/bin/env bash
# rlax.squashed_gaussian squashes the mean twice: no network can put the median action beyond 0.762 of the range.
#
# Expected: the policy of SAC and of the online decision transformer: u is normal with the network's mean, the action is
#           tanh(u), scaled to the action's bounds. A large mean gives actions close to a bound.
# Seen:     the mean goes through a tanh before the normal is drawn and u goes through another one, so the median lies
#           within tanh(1) = 0.7616 of the half range. sigma is squashed too, to between exp(-4) and 1. At the smallest
#           sigma no action passes 0.8; at the largest, with the mean at its limit, 5 % are above 0.99. entropy() is
#           that of u, up to 1.42 per element, while no distribution between -1 and 1 has more than log(2) = 0.69; the
#           mean of -logprob() is right. There is no message (Python hides the PendingDeprecationWarning, which
#           recommends distrax but does not say why). The docstring has one line, which names none of it. Issue 11 of
#           rlax asks what the transformations of mu and sigma are for.
# Versions: rlax 0.1.9 (the newest), distrax 0.1.9, jax and jaxlib 0.10.2, numpy 2.4.6; CPython 3.11, x86-64 Linux.
#           Seen on 2026-12-01.
# Matters:  D4RL's locomotion sets hold many actions close to a bound. This policy cannot imitate them: its density at
#           0.99 is 200 times smaller than it could be. A temperature tuned by entropy() aims at the wrong quantity.
# Way out:  distrax.Transformed of a MultivariateNormalDiag with the network's own mean, and Block(Tanh(), 1).
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile \
    rlax==0.1.9 distrax==0.1.9 chex==0.1.92 dm-env==1.6 tfp-nightly==0.26.0.dev20261027 \
    jax==0.10.2 jaxlib==0.10.2 numpy==2.4.6

cd "$folder"
JAX_PLATFORMS=cpu "$folder/venv/bin/python" - <<'PYTHON'
import math
import sys
from importlib.metadata import version
import distrax
import dm_env.specs
import jax
import jax.numpy as jnp
import numpy as np
import rlax

print(f"rlax {version('rlax')}, distrax {version('distrax')}, jax {jax.__version__}, jaxlib {version('jaxlib')}, "
      f"numpy {np.__version__}, on {jax.default_backend()}")
DRAWS = 40000
MEANS = jnp.array([[0.0], [1.0], [3.0], [10.0], [1000.0]])
policy = rlax.squashed_gaussian()


def spec(low, high):
    return dm_env.specs.BoundedArray((1,), np.float32, low, high)


def actions(sigma, bounds):
    keys = jax.random.split(jax.random.key(0), DRAWS)
    draw = jax.vmap(lambda key: policy.sample(key, MEANS, jnp.full_like(MEANS, sigma), bounds))
    return draw(keys)


def stop(text):
    sys.exit(f"The behaviour changed: {text}")


unit = spec(-1.0, 1.0)
print(f"bounds -1 and 1, {DRAWS} draws; the network's sigma is -1000, 0 or 1000")
print("  sigma   mean    median   largest  above 0.99   entropy()  mean of -logprob()")
entropies = []
for sigma in (-1000.0, 0.0, 1000.0):
    drawn = actions(sigma, unit)
    surprise = -jax.vmap(lambda action: policy.logprob(action, MEANS, jnp.full_like(MEANS, sigma), unit))(drawn)
    entropy = np.asarray(policy.entropy(MEANS, jnp.full_like(MEANS, sigma)))
    table = np.asarray(drawn)[..., 0]
    for i, mean in enumerate(np.asarray(MEANS)[:, 0]):
        column = table[:, i]
        above = (column > 0.99).mean()
        print(f"  {sigma:5.0f}  {mean:5.0f}  {np.median(column):8.4f}  {column.max():8.4f}  {above:10.4f}"
              f"  {entropy[i]:10.4f}  {float(surprise[:, i].mean()):10.4f}")
        if abs(np.median(column) - math.tanh(math.tanh(mean))) > 0.02:
            stop("the median was expected to be tanh(tanh(mean)).")
        if sigma == -1000 and column.max() > 0.8 or sigma == 1000 and above > 0.06:
            stop("fewer actions were expected near the bound.")
        # The entropy of a normal, although the action is not one.
        deviation = math.exp(-4 + 2 * (math.tanh(sigma) + 1))
        if abs(entropy[i] - (0.5 * math.log(2 * math.pi * math.e) + math.log(deviation))) > 1e-3:
            stop("entropy() was expected to be that of the normal.")
        entropies.append((float(entropy[i]), float(surprise[:, i].mean())))
print(f"  largest entropy(): {max(entropies)[0]:.4f}, its largest mean of -logprob(): "
      f"{max(value for _, value in entropies):.4f}, log(2): {math.log(2):.4f}")
if max(entropies)[0] < 1.4 or max(value for _, value in entropies) > math.log(2) + 0.02:
    stop("an entropy() above log(2) was expected, and a mean of -logprob() below.")

low, high = -2.0, 2.0
median = np.median(np.asarray(actions(-1000.0, spec(low, high)))[:, -1, 0])
print(f"bounds {low} and {high}: the largest median is {median:.4f}")
if abs(median - 2 * math.tanh(1)) > 0.01:
    stop("2 tanh(1) was expected.")


def single(mean, deviation):
    normal = distrax.MultivariateNormalDiag(jnp.array([mean]), jnp.array([deviation]))
    return distrax.Transformed(normal, distrax.Block(distrax.Tanh(), 1))


print("The best log-density that a policy can give to one action, over a grid of means and sigmas")
axes = jnp.meshgrid(jnp.linspace(-4, 4, 1601), jnp.linspace(-4, 4, 33))
grid = jnp.stack([axis.ravel() for axis in axes], axis=1)
for action in (0.5, 0.9, 0.99, 0.999):
    value = jnp.array([action])
    twice = jax.vmap(lambda pair: policy.logprob(value, pair[:1], pair[1:], unit))(grid).max()
    # The same smallest sigma, exp(-4), for both.
    once = jax.vmap(lambda mean: single(mean, math.exp(-4)).log_prob(value))(jnp.linspace(0, 4, 1601)).max()
    print(f"  action {action:5}  rlax {float(twice):7.3f}  tanh once {float(once):7.3f}")
    if action <= 0.5 and abs(twice - once) > 0.1 or action >= 0.99 and once - twice < 4:
        stop("equal densities were expected at 0.5, and much smaller ones for rlax from 0.99 on.")

sample = single(3.0, math.exp(-4)).sample(seed=jax.random.key(1), sample_shape=DRAWS)
print(f"The way out, mean 3: median {float(jnp.median(sample)):.4f}")
if abs(float(jnp.median(sample)) - math.tanh(3)) > 1e-3:
    stop("the way out was expected to give tanh(3).")
PYTHON
echo "Confirmed: rlax.squashed_gaussian squashes the mean before and after the normal."
