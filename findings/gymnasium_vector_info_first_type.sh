#!/usr/bin/env bash
# Gymnasium's vector environments cast each info to the type of the first one that reports it: 0.75 becomes 0.
#
# Expected: infos[key][i] is the number that sub-environment i put into its own info. Types are mixed as NumPy does it,
#           np.array([0, 0.75]) is float64, and the order of the sub-environments changes nothing but the order.
# Seen:     the array of a key gets the Python type of the first sub-environment that has the key in this step, and the
#           values of the others are assigned into it. After a 0 (int) the value 0.75 becomes 0, after False it becomes
#           True; with the order turned round both are right. "0 if nothing happened, else a fraction" is enough: of two
#           equal environments that have the cost 0.75 in turn, the second one's costs add up to 0 instead of 37.5 in
#           100 steps. SyncVectorEnv, AsyncVectorEnv and the final_info of SAME_STEP behave alike. There is no message;
#           rewards are not affected. In Meta-World's MT50 the first task, assembly-v3, reports obj_to_target = 0, an
#           int: the distance is 0 in all 50 tasks, while 45 of the sub-environments report 0.03 to 0.59 m. In MT10 the
#           first task reports a float, and all distances are right. The page on vector environments says that a key
#           gives the data of all sub-environments; neither it nor the docstrings name the type.
# Versions: gymnasium 1.4.0 (the newest), metaworld 3.1.1 (the newest; it asks for mujoco 3.3.0), numpy 2.4.6;
#           CPython 3.11, x86-64 Linux. Seen on 2026-12-01.
# Matters:  success, progress and cost of an evaluation are read from infos. They come out wrong, mostly too small, and
#           which of them do depends on what the environment with the lowest number happens to report in the same step.
# Way out:  a wrapper around each sub-environment that makes every number in info a float.
#
# Output seen on 2026-12-01:
#   gymnasium 1.4.0, metaworld 3.1.1, mujoco 3.3.0, numpy 2.4.6
#   Values of two sub-environments, and the infos of the vector environment:
#     0.75, 0       sync float64 [0.75, 0.0]       async float64 [0.75, 0.0]      final_info float64 [0.75, 0.0]
#     0, 0.75       sync int64 [0, 0]              async int64 [0, 0]             final_info int64 [0, 0]
#     False, 0.75   sync bool [False, True]        async bool [False, True]       final_info bool [False, True]
#     1, 0.75       sync int64 [1, 0]              async int64 [1, 0]             final_info int64 [1, 0]
#   The cost 0.75 in turn, sums over 100 steps: [37.5, 0.0]; with every number a float: [37.5, 37.5]
#   Meta-World MT10, obj_to_target: float64, 9 of 10 sub-environments report a distance, 9 arrive
#   Meta-World MT50, obj_to_target: int64, 45 of 50 sub-environments report a distance, 0 arrive
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile \
    gymnasium==1.4.0 metaworld==3.1.1 mujoco==3.3.0 numpy==2.4.6 scipy==1.17.1 imageio==2.38.1 packaging==26.4

cat > "$folder/infos.py" <<'PYTHON'
import functools
import sys
import warnings
warnings.simplefilter("ignore")
from importlib.metadata import version

import gymnasium
import metaworld  # registers the Meta-World environments
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

print(", ".join(f"{name} {version(name)}" for name in ("gymnasium", "metaworld", "mujoco", "numpy")))


class Reports(gymnasium.Env):
    """Puts the given values into its info, one a step, over and over again. Each episode has the given length."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, values, length):
        self.values, self.length, self.steps = values, length, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        value = self.values[self.steps % len(self.values)]
        self.steps += 1
        return np.zeros(1, np.float32), 0.0, False, self.steps == self.length, {"cost": value}


class FloatInfos(gymnasium.Wrapper):
    """The way out."""

    def step(self, action):
        *result, info = self.env.step(action)
        return *result, {key: float(value) if np.isscalar(value) else value for key, value in info.items()}


def check(value, expected):
    if value != expected:
        sys.exit(f"The behaviour changed: {expected} was expected instead of {value}.")


def infos_of_one_step(kind, values, **keywords):
    environments = kind([functools.partial(Reports, (value,), 1) for value in values], **keywords)
    environments.reset(seed=0)
    infos = environments.step(np.zeros((len(values), 1), np.float32))[-1]
    environments.close()
    return infos


print("Values of two sub-environments, and the infos of the vector environment:")
for values, expected in [((0.75, 0), [0.75, 0]), ((0, 0.75), [0, 0]), ((False, 0.75), [False, True]),
                         ((1, 0.75), [1, 0])]:
    line = f"  {values[0]}, {values[1]}".ljust(16)
    for name, infos in [
            ("sync", infos_of_one_step(SyncVectorEnv, values)),
            ("async", infos_of_one_step(AsyncVectorEnv, values)),
            ("final_info", infos_of_one_step(SyncVectorEnv, values, autoreset_mode=AutoresetMode.SAME_STEP)
             ["final_info"])]:
        array = infos["cost"]
        line += f"{name} {array.dtype} {array.tolist()}".ljust(31)
        check(array.tolist(), expected)
        check(infos["_cost"].tolist(), [True, True])
    print(line.rstrip())


def sums(wrapper):
    """Two equal environments, half a period apart: each has the cost 0.75 in 50 of 100 steps."""
    environments = SyncVectorEnv([lambda: wrapper(Reports((0.75, 0), 1000)), lambda: wrapper(Reports((0, 0.75), 1000))])
    environments.reset(seed=0)
    total = np.zeros(2)
    for _ in range(100):
        total += environments.step(np.zeros((2, 1), np.float32))[-1]["cost"]
    return total.tolist()


seen, with_floats = sums(lambda environment: environment), sums(FloatInfos)
print(f"The cost 0.75 in turn, sums over 100 steps: {seen}; with every number a float: {with_floats}")
check(seen, [37.5, 0.0])
check(with_floats, [37.5, 37.5])


def distances(name):
    """obj_to_target after one step: what the sub-environments returned, and what the vector environment returned."""
    environments = gymnasium.make_vec(name, vector_strategy="sync", seed=1, num_goals=1)
    returned = []

    def note(step, action):
        result = step(action)
        returned.append(float(result[-1]["obj_to_target"]))
        return result

    for environment in environments.envs:
        environment.step = functools.partial(note, environment.step)
    environments.reset()
    infos = environments.step(np.zeros(environments.action_space.shape, np.float32))[-1]
    environments.close()
    return np.array(returned), infos["obj_to_target"]


for name, dtype, arriving in [("MT10", "float64", 9), ("MT50", "int64", 0)]:
    returned, array = distances(f"Meta-World/{name}")
    reporting = returned > 0.02
    print(f"Meta-World {name}, obj_to_target: {array.dtype}, {reporting.sum()} of {len(returned)} sub-environments "
          f"report a distance, {np.sum(array[reporting] == returned[reporting])} arrive")
    check(str(array.dtype), dtype)
    check(int(reporting.sum()), {"MT10": 9, "MT50": 45}[name])
    check(int(np.sum(array[reporting] == returned[reporting])), arriving)
PYTHON

cd "$folder"
"$folder/venv/bin/python" infos.py
echo "Confirmed: the first sub-environment's type decides, and the numbers of the others are cut to it."
