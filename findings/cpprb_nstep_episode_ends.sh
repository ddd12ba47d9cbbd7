#!/usr/bin/env bash
# cpprb's n-step transitions at the end of an episode: done is 0 once too often or up to 6, and next_obs is all ones.
#
# Expected: the n-step done of a transition is 1 if one of its n steps is the terminal one, and 0 otherwise. The last
#           transitions, which on_episode_end() moves into the buffer, have the episode's last observation as next_obs.
# Seen:     1. The transition whose n-th step is the terminal one has done = 0, and the terminal state as next_obs. Its
#              target is rew + gamma^n V(terminal state) instead of rew. Only n - 1 of the n steps are looked at.
#           2. From n = 5 on the done of the first moved transitions is 2, 3, ..., and 6 for n = 10: each pass over the
#              local buffer adds values that earlier passes have added to. Then 1 - done is negative, and a state's
#              value enters the target with the wrong sign. With a bool done it stays 1.
#           3. The last n - 1 transitions have next_obs = 1 in each element: the local buffer is made full of ones, and
#              nothing is ever written to its "next" items. If a time limit ended the episode, done is 0 and the target
#              is rew + gamma^n V(1, 1, ...). There rew sums k < n rewards, so even with the right state gamma^n would
#              be the wrong factor; the sample does not tell k.
#           PrioritizedReplayBuffer and adding whole episodes give the same. There is no message. The page on n-step
#           says that done is replaced by its n-step version, that gamma^n is a fixed factor and on_episode_end() must
#           be called; the method's docstring has episodes in mind that end at some length without done.
# Versions: cpprb 11.0.0 (the newest), numpy 2.4.6; CPython 3.11, x86-64 Linux. Seen on 2026-12-01.
# Matters:  no transition starts in a terminal state, so the critic's value there is arbitrary, and it enters just
#           where the reward of a maze comes from. The value of one made-up state enters at every time limit.
# Way out:  no Nstep: form the sums oneself, and store gamma^k beside them.
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile --only-binary=:all: \
    cpprb==11.0.0 numpy==2.4.6

cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import sys
from importlib.metadata import version
import numpy as np
from cpprb import PrioritizedReplayBuffer, ReplayBuffer

print(f"cpprb {version('cpprb')}, numpy {np.__version__}")
GAMMA = 0.5


def items(done_type=np.float32):
    return {"obs": {"shape": 2}, "act": {"shape": 1}, "rew": {}, "next_obs": {"shape": 2}, "done": {"dtype": done_type}}


def walk(start, length, terminal):
    """A walk to the right along the line y = -x. The reward is x."""
    steps = []
    for t in range(length):
        x = float(start + t)
        done = float(terminal and t == length - 1)
        steps.append({"obs": (x, -x), "act": 0.0, "rew": x, "next_obs": (x + 1, -x - 1), "done": done})
    return steps


def endless(x):
    """The value of x in a walk that goes on for ever: the sum of GAMMA^k (x + k)."""
    return x / (1 - GAMMA) + GAMMA / (1 - GAMMA) ** 2


def exact_value(x, end):
    """The value of x if the walk is over at end. At the end itself a critic has learnt nothing; take endless(end)."""
    if end is None or x >= end:
        return endless(x)
    return sum(GAMMA ** k * (x + k) for k in range(round(end - x)))


def stored(n, walks, kind=ReplayBuffer, at_once=False, done_type=np.float32):
    buffer = kind(100, items(done_type), Nstep={"size": n, "gamma": GAMMA, "rew": "rew", "next": "next_obs"})
    for steps in walks:
        if at_once:
            buffer.add(**{name: np.array([step[name] for step in steps]) for name in items()})
        else:
            for step in steps:
                buffer.add(**step)
        buffer.on_episode_end()
    return buffer.get_all_transitions()


def by_hand(n, walks):
    buffer = ReplayBuffer(100, {**items(), "discount": {}})
    for steps in walks:
        for t, step in enumerate(steps):
            window = steps[t:t + n]
            buffer.add(obs=step["obs"], act=step["act"], rew=sum(GAMMA ** k * s["rew"] for k, s in enumerate(window)),
                       next_obs=window[-1]["next_obs"], done=window[-1]["done"], discount=GAMMA ** len(window))
    return buffer.get_all_transitions()


def wrong_targets(rows, discount, end=None):
    """Prints the targets under the exact value function, and returns the x of the rows where one is wrong."""
    wrong = []
    for obs, rew, following, done, factor in zip(rows["obs"], rows["rew"], rows["next_obs"], rows["done"], discount):
        target = float(rew[0] + (1 - done[0]) * factor * exact_value(float(following[0]), end))
        exact = exact_value(float(obs[0]), end)
        right = abs(target - exact) < 1e-3
        print(f"  obs {obs}  rew {rew[0]:7.3f}  next_obs {following}  done {done[0]:.0f}"
              f"  target {target:7.3f}  exact {exact:7.3f}  {'right' if right else 'WRONG'}")
        if not right:
            wrong.append(float(obs[0]))
    return wrong


def check(label, seen, expected):
    if not np.array_equal(seen, expected):
        sys.exit(f"The behaviour changed: {label}: {expected} was expected, {seen} was seen.")


N = 3
ended = [walk(100, 6, True)]
limited = [walk(100, 5, False), walk(200, 1, False)]

print(f"1. n = {N}, a walk of 6 steps, the last one with done = 1")
rows = stored(N, ended)
wrong = wrong_targets(rows, np.full(6, GAMMA ** N), end=106)
check("done", rows["done"][:, 0], [0, 0, 0, 0, 1, 1])
check("wrong targets", wrong, [103])

print("2. done of a walk of 12 steps, the last one with done = 1; right are n ones at the end")
DONE = {
    2: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1],
    3: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1],
    5: [0, 0, 0, 0, 0, 0, 0, 0, 2, 1, 1, 1],
    7: [0, 0, 0, 0, 0, 0, 3, 2, 2, 1, 1, 1],
    10: [0, 0, 0, 6, 5, 4, 3, 2, 2, 1, 1, 1],
}
for n, expected in DONE.items():
    rows = stored(n, [walk(100, 12, True)])
    print(f"  n = {n:2}  {rows['done'][:, 0].astype(int).tolist()}")
    check("done", rows["done"][:, 0], expected)
    truth = stored(n, [walk(100, 12, True)], done_type=bool)["done"][:, 0]
    check("done of type bool", truth, np.array(expected) > 0)

print(f"3. n = {N}, walks of 5 steps and of 1 step that a time limit ends, so that done is 0")
rows = stored(N, limited)
wrong = wrong_targets(rows, np.full(6, GAMMA ** N))
check("observations", rows["obs"][:, 0], [100, 101, 102, 103, 104, 200])
check("next observations", rows["next_obs"], [[103, -103], [104, -104], [105, -105], [1, 1], [1, 1], [1, 1]])
check("wrong targets", wrong, [103, 104, 200])

for kind, at_once in ((ReplayBuffer, True), (PrioritizedReplayBuffer, False)):
    for n, walks in ((N, ended), (N, limited), (10, [walk(100, 12, True)])):
        usual, other = stored(n, walks), stored(n, walks, kind, at_once)
        for name in ("rew", "next_obs", "done"):
            check(name, other[name], usual[name])
    print(f"{kind.__name__}, {'an episode' if at_once else 'a step'} at a time: the same")

print("The way out: sums formed by hand, with gamma^k beside them")
for walks, end in ((ended, 106), (limited, None)):
    rows = by_hand(N, walks)
    check("wrong targets", wrong_targets(rows, rows["discount"][:, 0], end), [])
PYTHON
echo "Confirmed: at the end of an episode done and next_obs of cpprb's n-step transitions are wrong."
