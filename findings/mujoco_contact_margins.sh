#!/usr/bin/env bash
# MuJoCo 3.5.0 adds the contact margins of two geoms; MuJoCo 3.4.0 takes the larger one.
#
# Expected: a contact exists while the distance is below the larger of the two margins, in every MuJoCo 2, 3 and 4.
# Seen:     from 3.5.0 on the threshold is the sum of the margins. The same XML file gives other contacts and heights:
#           a ball with the numbers of Ant's torso rests 1 cm higher. There is no message.
# Versions: mujoco 3.4.0 (larger), 3.5.0 and 4.0.0 (sum); numpy 2.4.6; CPython 3.11, x86-64 Linux. Seen on 2026-11-29.
# Matters:  Gym's XML files of Hopper (0.001) and Ant (0.01) give the margin in <default>, so the floor has it too.
#           A decision transformer trained on D4RL data then meets contacts that begin at twice the distance.
# Way out:  margin="0" on the floor. The larger of 0 and m is m, and so is the sum: all three versions agree.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

cat > "$folder/margins.py" <<'PYTHON'
import sys
import mujoco

rule_name = sys.argv[1]
rule = {"larger": max, "sum": lambda a, b: a + b}[rule_name]
radius = 0.25

MODEL = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <geom type="plane" size="40 40 40" margin="{floor}"/>
    <body pos="0 0 0.4">
      <freejoint/>
      <geom type="sphere" size="{radius}" density="5" margin="{ball}"/>
    </body>
  </worldbody>
</mujoco>
"""


def model(ball, floor):
    return mujoco.MjModel.from_xml_string(MODEL.format(ball=ball, floor=floor, radius=radius))


def largest_gap_with_contact(ball, floor):
    """The largest gap between ball and floor, in steps of 0.1 mm, at which MuJoCo reports a contact."""
    m = model(ball, floor)
    d = mujoco.MjData(m)
    largest = 0.0
    for step in range(300):
        gap = (step + 0.5) * 1e-4
        d.qpos[2] = radius + gap
        mujoco.mj_forward(m, d)
        if d.ncon == 1:
            largest = gap
    return largest


def resting_gap(ball, floor):
    """The gap that is left 10 s after the ball was released."""
    m = model(ball, floor)
    d = mujoco.MjData(m)
    for _ in range(1000):
        mujoco.mj_step(m, d)
    return d.qpos[2] - radius


print(f"mujoco {mujoco.__version__}: expected rule: {rule_name}")
print("  margin of ball, floor   contact up to   resting gap")
for ball, floor in [(0.01, 0.01), (0.01, 0.004), (0.004, 0.01), (0.01, 0.0)]:
    reach = largest_gap_with_contact(ball, floor)
    rest = resting_gap(ball, floor)
    print(f"  {ball:.3f}, {floor:.3f}            {reach:.5f} m       {rest:.5f} m")
    threshold = rule(ball, floor)
    if abs(reach - threshold) > 1e-4:
        sys.exit(f"The behaviour changed: the contact was expected up to {threshold} m.")
    if not threshold - 0.001 < rest < threshold:
        sys.exit(f"The behaviour changed: the ball was expected to rest just below {threshold} m.")
PYTHON

for case in 3.4.0:larger 3.5.0:sum 4.0.0:sum; do
    version=${case%%:*}
    python3 -m venv "$folder/$version"
    "$folder/$version/bin/pip" install --quiet --disable-pip-version-check --no-compile "mujoco==$version" numpy==2.4.6
    "$folder/$version/bin/python" "$folder/margins.py" "${case##*:}"
done
echo "Confirmed: 3.4.0 takes the larger margin, 3.5.0 and 4.0.0 take the sum."
