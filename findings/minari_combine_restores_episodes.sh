#!/usr/bin/env bash
# Minari: combine_datasets ignores which episodes were chosen; episodes filtered out or split off come back.
#
# Expected: filter_episodes and split_dataset return data sets, whose length, total_steps, iteration and sampling are
#           those of the chosen episodes; combining two of them gives these episodes and no others.
# Seen:     combine_datasets copies everything that lies on the disk behind each of its inputs, in the stored order.
#           Two data sets cut down to their best episode, of return 90 each, give all 8 episodes when combined, with a
#           mean of 45; the two parts of a split give every episode twice. The episodes' seeds are lost on the way.
#           iterate_episodes([0]) counts in the stored order too and yields an episode that was filtered out, whereas
#           dataset[0] is the first chosen one. There is no message. An open pull request of Minari's (350) says so
#           of combine_datasets; 0.5.4 is the newest release.
# Versions: minari 0.5.4, gymnasium 1.4.0, h5py 3.16.0, numpy 2.4.6, pillow 12.2.0; CPython 3.11, x86-64 Linux.
#           Seen on 2026-12-01.
# Matters:  mixtures (medium and expert, the best tenth of each of several sets, a training part with another set) are
#           made in this way. The policy is then trained on the poor episodes, or on those held out to judge it; only
#           the number of episodes shows it.
# Way out:  build the episodes anew from the chosen ones and store them with create_dataset_from_buffers.
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile \
    "minari[hdf5]==0.5.4" gymnasium==1.4.0 h5py==3.16.0 numpy==2.4.6 pillow==12.2.0

cd "$folder"
MINARI_DATASETS_PATH="$folder/sets" "$folder/venv/bin/python" - <<'PYTHON'
import sys
import warnings
warnings.simplefilter("ignore")
import gymnasium
import h5py
import minari
import numpy as np
import PIL
from minari.data_collector import EpisodeBuffer

print(f"minari {minari.__version__}, gymnasium {gymnasium.__version__}, "
      f"h5py {h5py.__version__}, numpy {np.__version__}, pillow {PIL.__version__}")
STEPS = 3
SPACES = {
    "observation_space": gymnasium.spaces.Box(-1000, 1000, (2,), np.float32),
    "action_space": gymnasium.spaces.Box(-1, 1, (1,), np.float32),
}


def store(name, episodes_return, first_seed):
    """A data set with an episode for each return."""
    buffers = []
    for index, total in enumerate(episodes_return):
        buffers.append(EpisodeBuffer(
            seed=first_seed + index,
            observations=np.full((STEPS + 1, 2), total, dtype=np.float32),
            actions=np.zeros((STEPS, 1), dtype=np.float32),
            rewards=np.full(STEPS, total / STEPS),
            terminations=np.zeros(STEPS, dtype=bool),
            truncations=np.arange(STEPS) == STEPS - 1))
    return minari.create_dataset_from_buffers(name, buffers, data_format="hdf5", **SPACES)


def returns(episodes):
    return [round(float(episode.rewards.sum())) for episode in episodes]


def seeds(dataset):
    return [metadata.get("seed") for metadata in dataset.storage.get_episode_metadata(dataset.episode_indices)]


def check(label, value, expected):
    print(f"  {label:54} {value}")
    if value != expected:
        sys.exit(f"The behaviour changed: {expected} was expected.")


medium = store("medium-v0", [30, 0, 90, 60], 100)
expert = store("expert-v0", [60, 90, 0, 30], 200)

print("The best episode of each of two data sets, by filter_episodes:")
best = [dataset.filter_episodes(lambda episode: episode.rewards.sum() >= 89) for dataset in (medium, expert)]
check("returns", [returns(dataset) for dataset in best], [[90], [90]])
check("len, total_steps", [(len(dataset), dataset.total_steps) for dataset in best], [(1, STEPS), (1, STEPS)])
check("seeds", [seeds(dataset) for dataset in best], [[102], [201]])
check("return of best[0][0]", returns([best[0][0]]), [90])
check("return of best[0].iterate_episodes([0])", returns(best[0].iterate_episodes([0])), [30])

print("combine_datasets of the two:")
mixed = minari.combine_datasets(best, "mixed-v0")
check("returns", returns(mixed), [30, 0, 90, 60, 60, 90, 0, 30])
check("len, total_steps", (len(mixed), mixed.total_steps), (8, 8 * STEPS))
check("mean return", float(np.mean(returns(mixed))), 45.0)
check("seeds", seeds(mixed), [None] * 8)
check("returns after load_dataset", returns(minari.load_dataset("mixed-v0")), returns(mixed))

print("split_dataset(medium, [3, 1], seed=1), and combine_datasets:")
training, held_out = minari.split_dataset(medium, [3, 1], seed=1)
check("episodes in the parts", [len(training), len(held_out)], [3, 1])
check("all episodes in one of the parts", sorted(returns(training) + returns(held_out)), [0, 30, 60, 90])
leaking = minari.combine_datasets([training], "leaking-v0")
check("returns of the training part alone, combined", returns(leaking), [30, 0, 90, 60])
check("episode held out is in it", returns(held_out)[0] in returns(leaking), True)
check("returns of both parts, combined", returns(minari.combine_datasets([training, held_out], "both-v0")),
      [30, 0, 90, 60] * 2)

print("The way out:")
buffers = []
for dataset in best:
    for episode, seed in zip(dataset, seeds(dataset)):
        buffers.append(EpisodeBuffer(
            seed=seed, observations=episode.observations, actions=episode.actions, rewards=episode.rewards,
            terminations=episode.terminations, truncations=episode.truncations))
chosen = minari.create_dataset_from_buffers("chosen-v0", buffers, data_format="hdf5", **SPACES)
check("returns", returns(chosen), [90, 90])
check("seeds", seeds(chosen), [102, 201])
PYTHON
echo "Confirmed: combine_datasets brings back the episodes that were filtered out."
