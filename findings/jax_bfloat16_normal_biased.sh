#!/usr/bin/env bash
# jax.random.normal in bfloat16 takes 128 values only, none above 2.52, and its mean is -0.011 instead of 0.
#
# Expected: a normal sample in bfloat16 is a rounded float32 sample: mean 0, symmetric, thousands of values, up to 5.
# Seen:     the uniform number before erfinv has 7 random bits, counted upwards from just above -1. The result lies in
#           [-2.89, 2.52], and the grid leans to the left. The initialisers of jax.nn that draw in the dtype of the
#           weights pass this on: behind a ReLU with 2048 inputs the outputs of a fresh layer have a common mean of
#           -0.3 (normal) to -0.45 (lecun_normal, the default of flax's Dense) of their standard deviation. In
#           float16 the mean is -0.0018. The documentation of random.normal gives an unbounded domain for every dtype,
#           that of initializers.normal says "mean 0"; neither mentions the dtype's part in it.
# Versions: jax and jaxlib 0.10.2; numpy 2.4.6; CPython 3.11, x86-64 Linux. Seen on 2026-11-30.
# Matters:  the weights of a decision transformer with param_dtype=bfloat16 are not GPT-2's N(0, 0.02), and the noise
#           of a stochastic policy drawn in bfloat16 never passes 2.52 deviations upwards, but 2.89 downwards.
#           A LayerNorm behind the layer subtracts a common mean; an MLP without one keeps it.
# Way out:  draw in float32, then .astype(bfloat16).
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile jax==0.10.2 jaxlib==0.10.2 numpy==2.4.6

JAX_PLATFORMS=cpu "$folder/venv/bin/python" - <<'PYTHON'
import sys
import jax
import jax.numpy as jnp
import jaxlib
import numpy as np

print(f"jax {jax.__version__}, jaxlib {jaxlib.__version__}, numpy {np.__version__}, on {jax.default_backend()}")
DRAWS = {
    "bfloat16": lambda draw: draw(jnp.bfloat16),
    "float16": lambda draw: draw(jnp.float16),
    "float32, rounded to bfloat16": lambda draw: draw(jnp.float32).astype(jnp.bfloat16),
}

print("random.normal, 4 million numbers        values   smallest  largest   mean")
for name, variant in DRAWS.items():
    z = np.asarray(variant(lambda dtype: jax.random.normal(jax.random.key(0), (4_000_000,), dtype))).astype(np.float64)
    values = len(np.unique(z))
    print(f"  {name:36}  {values:6}   {z.min():8.4f}  {z.max():7.4f}  {z.mean():8.4f}")
    right = {
        "bfloat16": values == 128 and -2.95 < z.min() < -2.8 and 2.4 < z.max() < 2.6 and -0.014 < z.mean() < -0.008,
        "float16": values == 1024 and z.max() < 3.3 and -0.0035 < z.mean() < -0.0005,
    }.get(name, values > 2000 and z.min() < -4.5 and z.max() > 4.5 and abs(z.mean()) < 0.002)
    if not right:
        sys.exit("The behaviour changed: other numbers were expected.")

# The second layer of an MLP: 2048 inputs behind a ReLU, 512 outputs, 256 rows. Everything after the draw is float64.
inputs = np.maximum(np.random.default_rng(0).standard_normal((256, 2048)), 0)
INITIALISERS = {
    "normal(0.02)": (jax.nn.initializers.normal(0.02), 0.3),
    "lecun_normal()": (jax.nn.initializers.lecun_normal(), 0.45),
}
print("mean of the layer's outputs, in their standard deviations, for three keys")
for title, (initialiser, shift) in INITIALISERS.items():
    for name, variant in DRAWS.items():
        if name == "float16":
            continue
        means = []
        for seed in range(3):
            draw = variant(lambda dtype: initialiser(jax.random.key(seed), (2048, 512), dtype))
            outputs = inputs @ np.asarray(draw).astype(np.float64)
            means.append(outputs.mean() / outputs.std())
        print(f"  {title:15} {name:28} " + "  ".join(f"{mean:7.3f}" for mean in means))
        expected = -shift if name == "bfloat16" else 0.0
        if any(abs(mean - expected) > 0.08 for mean in means):
            sys.exit(f"The behaviour changed: about {expected} was expected.")
PYTHON
