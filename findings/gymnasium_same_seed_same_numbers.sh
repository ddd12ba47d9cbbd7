#!/usr/bin/env bash
# Gymnasium: after reset(seed=s) and action_space.seed(s) the first random actions are the noise of the initial state.
#
# Expected: the environment and its action space have generators of their own (sample() is repeatable only after the
#           space was seeded too), so random actions are independent of the state whatever the seeds.
# Seen:     both generators are PCG64 made from the bare seed; with one seed for both they are the same stream.
#           Hopper-v5 draws 12 uniform numbers for its initial state (6 positions, 6 velocities, +-0.005), and the
#           random actions 1 to 4, of 3 numbers each, are these numbers times 200. With another seed for the space they
#           are not. Pendulum-v1's first action is 2 / pi times its initial angle. There is no message, and the order
#           of the calls is of no importance. The text of neither method warns; SyncVectorEnv's example gives both 42.
# Versions: gymnasium 1.4.0, mujoco 3.17.0, numpy 2.4.6; CPython 3.11, x86-64 Linux. Seen on 2026-12-01.
# Matters:  whoever collects random episodes (a random data set, the warm-up of a replay) with one seed per episode for
#           both gets first actions that a model predicts from the first observation without error: the data are not
#           those of a random policy, and a test of a behaviour model on them is too good. With one seed per run it is
#           the first episode only.
# Way out:  numpy.random.SeedSequence(seed).generate_state(2): one number for reset(), one for action_space.seed().
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile \
    gymnasium==1.4.0 mujoco==3.17.0 imageio==2.38.1 packaging==26.4 numpy==2.4.6

cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import sys
import gymnasium
import mujoco
import numpy as np

print(f"gymnasium {gymnasium.__version__}, mujoco {mujoco.__version__}, numpy {np.__version__}")


def numbers(*values):
    return " ".join(f"{value:8.4f}" for value in values)


hopper = gymnasium.make("Hopper-v5")
SCALE = hopper.unwrapped._reset_noise_scale
START = np.concatenate([hopper.unwrapped.init_qpos, hopper.unwrapped.init_qvel])


def noise_and_actions(reset_seed, action_seed, space_first=False):
    """Hopper's initial noise in units of its scale (12 numbers), and four random actions (12 numbers)."""
    if space_first:
        hopper.action_space.seed(action_seed)
    hopper.reset(seed=reset_seed)
    if not space_first:
        hopper.action_space.seed(action_seed)
    data = hopper.unwrapped.data
    noise = (np.concatenate([data.qpos, data.qvel]) - START) / SCALE
    return noise, np.concatenate([hopper.action_space.sample() for _ in range(4)])


print(f"Hopper-v5, reset(seed=7): initial noise / {SCALE}, and four random actions")
noise, same = noise_and_actions(7, 7)
_, before = noise_and_actions(7, 7, space_first=True)
_, other = noise_and_actions(7, 8)
for row in range(4):
    part = slice(3 * row, 3 * row + 3)
    print(f"  noise {numbers(*noise[part])}   action, seed 7 {numbers(*same[part])}   seed 8 {numbers(*other[part])}")
if np.abs(noise - same).max() > 1e-6 or not np.array_equal(same, before) or np.abs(noise - other).max() < 0.5:
    sys.exit("The behaviour changed: with seed 7 the actions were expected to be the noise, with seed 8 not.")

# A data set of 500 episodes, a seed for each; how much of the first action a linear function of the observation gives.
EPISODES = 500
print(f"Hopper-v5, {EPISODES} episodes: part of the first action's variance that is linear in the observation (R^2)")
for name, offset in (("same seed", 0), ("other seed", 100000)):
    observations, actions = [], []
    for episode in range(EPISODES):
        observation, _ = hopper.reset(seed=episode)
        hopper.action_space.seed(episode + offset)
        observations.append(observation)
        actions.append(hopper.action_space.sample())
    x = np.column_stack([np.array(observations), np.ones(EPISODES)])
    y = np.array(actions, dtype=np.float64)
    rest = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    share = 1 - rest.var(axis=0) / y.var(axis=0)
    print(f"  {name:10} {numbers(*share)}")
    # The first number moves the horizontal position, which Hopper does not observe.
    expected = share[0] < 0.1 and share[1:].min() > 0.999999 if offset == 0 else share.max() < 0.1
    if not expected:
        sys.exit("The behaviour changed: about 0 1 1 was expected with the same seed, about 0 0 0 with another.")

pendulum = gymnasium.make("Pendulum-v1")
print("Pendulum-v1: 2 / pi times the initial angle, and the first random action")
for seed in (0, 1, 123):
    observation, _ = pendulum.reset(seed=seed)
    pendulum.action_space.seed(seed)
    angle = np.arctan2(observation[1], observation[0])
    action = pendulum.action_space.sample()[0]
    print(f"  seed {seed:3} {numbers(2 / np.pi * angle, action)}")
    if abs(2 / np.pi * angle - action) > 1e-5:
        sys.exit("The behaviour changed: the two were expected to be equal.")

reset_seed, action_seed = (int(word) for word in np.random.SeedSequence(7).generate_state(2))
noise, actions = noise_and_actions(reset_seed, action_seed)
print(f"The way out, seed 7: noise {numbers(*noise[:3])}   action {numbers(*actions[:3])}")
if np.abs(noise - actions).max() < 0.5:
    sys.exit("The way out was expected to give other numbers.")
PYTHON
echo "Confirmed: one seed for the environment and for its action space gives both the same numbers."
