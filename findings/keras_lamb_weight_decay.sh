#!/usr/bin/env bash
# Keras's Lamb leaves the weight decay out of the trust ratio: a matrix can decay tens of times faster.
#
# Expected: LAMB (You et al., 2020) adds the decay to Adam's direction, u = r + decay * w, and the trust ratio
#           norm(w) / norm(u) scales both: a step has the length lr * norm(w) whatever the decay. optax.lamb does so.
# Seen:     keras.optimizers.Lamb first shrinks w by lr * decay, as AdamW does, and scales r alone. In the first step
#           of a 64 x 64 matrix of GPT-2's standard deviation 0.02 the decay acts 50 times as strongly as the paper's.
# Versions: keras 3.15.1 on jax 0.10.2, optax 0.2.8, numpy 2.4.6; CPython 3.11, x86-64 Linux. Seen on 2026-11-29.
# Matters:  online decision transformers are trained by LAMB with weight decay. With the same name and the same numbers
#           a Keras port decays far more. With weight decay 0 both agree, so a test without decay does not notice.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile \
    keras==3.15.1 optax==0.2.8 jax==0.10.2 jaxlib==0.10.2 numpy==2.4.6

KERAS_HOME="$folder" KERAS_BACKEND=jax JAX_PLATFORMS=cpu "$folder/venv/bin/python" - <<'PYTHON'
import sys
import jax
import jax.numpy as jnp
import keras
import numpy as np
import optax

print(f"keras {keras.__version__}, optax {optax.__version__}, jax {jax.__version__}, numpy {np.__version__}")
RATE, BETA1, BETA2, EPSILON = 0.01, 0.9, 0.999, 1e-6


def keras_step(w, gradient, decay):
    variable = keras.Variable(w)
    optimizer = keras.optimizers.Lamb(
        learning_rate=RATE, beta_1=BETA1, beta_2=BETA2, epsilon=EPSILON, weight_decay=decay)
    optimizer.build([variable])
    optimizer.apply([keras.ops.convert_to_tensor(gradient)], [variable])
    return w - np.asarray(variable.value, dtype=np.float64)


def optax_step(w, gradient, decay):
    optimizer = optax.lamb(RATE, b1=BETA1, b2=BETA2, eps=EPSILON, weight_decay=decay)
    update, _ = optimizer.update(jnp.asarray(gradient), optimizer.init(jnp.asarray(w)), jnp.asarray(w))
    return -np.asarray(update, dtype=np.float64)


def paper_step(w, gradient, decay):
    """The first step in float64. After bias correction m is the gradient and v its square."""
    w, gradient = w.astype(np.float64), gradient.astype(np.float64)
    u = gradient / (np.abs(gradient) + EPSILON) + decay * w
    return RATE * np.linalg.norm(w) / np.linalg.norm(u) * u


def shrinkage(step, w, gradient, decay):
    """The part of w that the decay takes away: the step with decay less the step without, along w."""
    difference = step(w, gradient, decay) - step(w, gradient, 0.0)
    return float(np.sum(difference * w) / np.sum(w * w))


STEPS = {"paper": paper_step, "optax": optax_step, "keras": keras_step}

w = np.array([3.0, 4.0], dtype=np.float32)
gradient = np.array([0.1, -0.2], dtype=np.float32)
print("w = (3, 4), gradient (0.1, -0.2): first step and its length; lr * norm(w) is 0.05")
for decay in (0.0, 0.1, 1.0):
    reference = paper_step(w, gradient, decay)
    for name, step in STEPS.items():
        taken = step(w, gradient, decay)
        print(f"  decay {decay:3}  {name}  ({taken[0]:.5f}, {taken[1]:.5f})  {np.linalg.norm(taken):.5f}")
        as_paper = np.abs(taken - reference).max() < 5e-6
        if as_paper != (name != "keras" or decay == 0.0):
            sys.exit("The behaviour changed: only keras with a decay was expected to differ from the paper.")

generator = np.random.default_rng(1)
w = generator.normal(0.0, 0.02, (64, 64)).astype(np.float32)
gradient = generator.normal(0.0, 1.0, (64, 64)).astype(np.float32)
decay = 0.1
print(f"64 x 64 weights of deviation 0.02, decay {decay}: part lost to the decay; lr * decay is {RATE * decay:g}")
shrunk = {name: shrinkage(step, w, gradient, decay) for name, step in STEPS.items()}
for name, value in shrunk.items():
    print(f"  {name}  {value:.3e}")
factor = shrunk["keras"] / shrunk["paper"]
print(f"  keras / paper = {factor:.1f}")
if not (40 < factor < 60 and abs(shrunk["optax"] / shrunk["paper"] - 1) < 0.05):
    sys.exit("The behaviour changed: a factor of about 50 for keras and 1 for optax was expected.")
PYTHON
echo "Confirmed: keras applies the weight decay outside the trust ratio."
