// antmaze.hpp: how D4RL made its antmaze data: an ant that walks in a commanded direction, a planner on the maze's
// cells that gives the command, and rewards that are written in afterwards.
//
//   planner      MazePlan of waypoints.hpp: for each cell the next one
//   walker       WalkingAnt is the task that sac.hpp trains a walker on; the trained one lies in data/policies
//   data set     8 arrays of a row per step, those of D4RL's files
//
// Promises: a data set is a function of (task, steps, seed, policy, machine); a shorter set is the beginning of a
// longer one, except for its last reward. collect_ant_maze_set says what is chosen where D4RL's script leaves it open.
// Leaves out: numpy's random numbers; files (collect.hpp); how the policy is trained (collect.hpp, sac.hpp).
#pragma once

#include <numbers>

#include "../mujoco_env.hpp"
#include "rows.hpp"
#include "sac.hpp"
#include "waypoints.hpp"

// ---------------------------------------------------------------------------------------------------------------------
// The planner. D4RL counts a position to the column 1 + floor(x / 4), so a cell begins at its own centre: an ant that
// has reached a way-point turns to the next one.

constexpr double ant_cell = 4;  // m

inline MazeCell ant_cell_of(double x, double y) {
    const auto index = [](double at) { return 1 + static_cast<int>(std::floor(std::max(at, 1e-4) / ant_cell)); };
    return {index(y), index(x)};
}
inline MazePoint ant_cell_centre(MazeCell cell) {
    return {ant_cell * (cell.column - 1), ant_cell * (cell.row - 1)};  // x, y
}

// ---------------------------------------------------------------------------------------------------------------------
// The walker.

constexpr const char* walker_name = "antmaze-walker";

#ifdef WODTEM_MUJOCO

constexpr int walking_ant_state = 27;

// Writes what the walker sees, [27]: the observation without x and y, in a frame whose x axis is the commanded
// direction, `heading`, rad, from the world's x axis.
// departs from D4RL's walker: that one is given the 27 numbers and the direction as two more.
// The floor looks the same from all sides, so what was learned for one direction holds for all. Of the quaternions q
// and -q, which are one rotation, the walker sees the one with w >= 0.
inline void see_from(double heading, std::span<const double> observation, float* seen) {
    const double c = std::cos(heading), s = std::sin(heading);
    const double turn_w = std::cos(heading / 2), turn_z = -std::sin(heading / 2);  // a rotation by -heading about z
    const double w = observation[3], x = observation[4], y = observation[5], z = observation[6];
    const double vx = observation[15], vy = observation[16];
    for (size_t i = 0; i < walking_ant_state; ++i) seen[i] = static_cast<float>(observation[2 + i]);
    const std::array<double, 4> turned = {turn_w * w - turn_z * z, turn_w * x - turn_z * y, turn_w * y + turn_z * x,
                                          turn_w * z + turn_z * w};
    for (size_t i = 0; i < 4; ++i) seen[1 + i] = static_cast<float>(turned[0] < 0 ? -turned[i] : turned[i]);
    seen[13] = static_cast<float>(c * vx + s * vy);
    seen[14] = static_cast<float>(c * vy - s * vx);
}

// Moves an ant that has just been reset, [x, y] m.
inline void move_start(MujocoEnvironment& body, MazePoint by) {
    std::vector<double> qpos(body.data->qpos, body.data->qpos + body.model->nq);
    const std::vector<double> qvel(body.data->qvel, body.data->qvel + body.model->nv);
    for (size_t i = 0; i < 2; ++i) qpos[i] += by[i];
    body.start(qpos, qvel);
}

// antmaze's ant far from all walls; the reward is its speed, m/s, in a direction that is drawn anew every 50 steps. An
// episode ends when the ant falls: its torso leaves the heights that gym's ant allows, or tilts by more than pi / 2.
struct WalkingAnt : Environment {
    static constexpr int steps_per_direction = 50, max_episode_steps = 500;
    static constexpr double away = 100;          // m, from the maze along x and y
    static constexpr uint32_t first_draw = 100;  // after those of the body's reset

    MujocoEnvironment body{*find_mujoco_task("antmaze-umaze"), Physics::d4rl};
    Random random{0, Stream::environment};
    uint64_t episode = 0;
    double heading = 0;

    EnvironmentSpec spec() const override { return {walking_ant_state, body.task->action_dim, 0, max_episode_steps}; }

    void reset(const Random& chance, uint64_t number, float* state) override {
        random = chance;
        episode = number;
        std::vector<float> ignored(body.observation.size());
        body.reset(chance, number, ignored.data());
        move_start(body, {away, away});
        choose_direction();
        see_from(heading, body.observation, state);
    }

    Step step(const float* action, float* state) override {
        const double* qpos = body.data->qpos;
        const double x = qpos[0], y = qpos[1];
        body.advance(std::vector<double>(action, action + body.task->action_dim));
        const double speed = ((qpos[0] - x) * std::cos(heading) + (qpos[1] - y) * std::sin(heading)) / body.step_time();
        // The height of the torso's own z axis is 1 - 2 (qx^2 + qy^2).
        const bool upright = qpos[4] * qpos[4] + qpos[5] * qpos[5] < 0.5;
        const bool fallen = !(qpos[2] >= 0.2 && qpos[2] <= 1.0 && upright);
        if (body.steps % steps_per_direction == 0) choose_direction();
        see_from(heading, body.observation, state);
        return {speed, fallen};
    }

    std::unique_ptr<Environment> clone() const override { return std::make_unique<WalkingAnt>(*this); }

    void choose_direction() {
        heading = 2 * std::numbers::pi * random.uniform(episode, first_draw + static_cast<uint32_t>(body.steps));
    }
};

// ---------------------------------------------------------------------------------------------------------------------
// The data set.

constexpr double ant_noise = 0.2;  // of an action: times a standard normal; then clipped to [-1, 1]

// The sites of the draws from Stream::data_set (step: the episode, index: the time-step); + 1 is for y, after x.
namespace AntDraw {
constexpr uint32_t noise = 0;        // + action dimension
constexpr uint32_t waypoint = 8;     // scatter of the sub-goal
constexpr uint32_t start_cell = 10;  // index 0, here and below
constexpr uint32_t start = 11, goal_cell = 13, goal = 14;
}  // namespace AntDraw

// Writes rewards and terminals: 1 where the next row's observation is within 0.5 m of one goal for all rows, else 0.
// Across the end of an episode this looks into the next one, as D4RL's script does; the last row has 0. `once`: of each
// run of ones the first alone stays, as is reported of umaze-diverse's file; umaze's has whole runs.
inline void relabel(CollectedRows<float>& set, MazePoint goal, bool once) {
    set.rewards.assign(set.length(), 0);
    bool inside = false;
    for (size_t row = 0; row + 1 < set.length(); ++row) {
        const float* next = &set.observations[29 * (row + 1)];
        const bool was = std::exchange(inside, std::hypot(next[0] - goal[0], next[1] - goal[1]) <= goal_radius);
        set.rewards[row] = inside && !(once && was);
    }
    set.numeric_terminals = set.rewards;
}

// The heading, rad, from the ant to the next cell's centre plus `scatter`, uniform [0, 1) per coordinate and drawn anew
// in every step, or to the goal where that is in the next cell.
inline double heading_to_goal(const MazePlan& plan, MazePoint at, MazePoint goal, MazePoint scatter) {
    const MazeCell cell = ant_cell_of(at[0], at[1]), end = ant_cell_of(goal[0], goal[1]);
    // Off the map, or behind its outermost walls, there is no next cell, and the ant heads for the goal.
    const MazeCell next = plan.grid.contains(cell.row, cell.column) ? plan.next[plan.grid.number(cell)] : end;
    MazePoint aim = goal;
    if (next.row >= 0 && !(next.row == end.row && next.column == end.column))
        for (size_t i = 0; i < 2; ++i) aim[i] = ant_cell_centre(next)[i] + scatter[i];
    return std::atan2(aim[1] - at[1], aim[0] - at[0]);
}

// Row t has what was so before step t and that step's action, and, as in D4RL, infos/qpos and infos/qvel after it.
// rewards and terminals are 0 or 1, both numbers; goal: the episode's own. Episodes end by the limit alone and last 701
// steps, because the script tests its counter before it increments it, and go on after success. So they are longer than
// an episode of play(), and `steps` may cut the last one. The script leaves open, and here is chosen:
//   - antmaze-umaze: each episode goes to the goal that the environment draws at its reset, from the start cell.
//   - antmaze-umaze-diverse (multistart, multigoal; the script has the first alone): the episode starts in a free cell
//     drawn uniformly (the goal's counts as wall), plus uniform [0, 1) per coordinate, raised to at least 0, and goes
//     to a free cell (here the goal's counts too) drawn alike, plus uniform [0, 1).
//   - the walker takes its mean action, to which the noise is added.
// An episode in which the simulation breaks down is dropped, as in D4RL. `progress` gets the number of rows after every
// episode.
inline CollectedRows<float> collect_ant_maze_set(const MujocoTask& task, size_t steps, uint32_t seed,
                                                 sac::Network<float>& walker,
                                                 const std::function<void(size_t)>& progress = {}) {
    const bool diverse = std::string_view(task.name) == "antmaze-umaze-diverse";
    const Random random{seed, Stream::data_set}, resets{seed, Stream::environment};
    MujocoEnvironment environment(task, Physics::d4rl);
    Compute compute(best_kernel(), 1);
    Tape<float> tape(compute);
    std::vector<float> state(29), seen(walking_ant_state);
    const std::vector<float> no_noise(8);  // of the walker's own
    const MazeGrid grid{task.maze};
    CollectedRows<float> set;
    for (uint64_t episode = data_set_episodes; set.length() < steps; ++episode) {
        environment.reset(resets, episode, state.data());
        const std::span qpos(environment.data->qpos, 15), qvel(environment.data->qvel, 14);
        MazePoint goal = environment.goal;
        if (diverse) {
            const auto draw = [&](const std::vector<MazeCell>& cells, uint32_t cell, uint32_t place) {
                const MazeCell drawn = cells[random.below(cells.size(), episode, 0, cell)];
                return scattered(ant_cell_centre(drawn), 0, 1, random, episode, 0, place);
            };
            goal = draw(grid.cells("0RG"), AntDraw::goal_cell, AntDraw::goal);
            const MazePoint start = draw(grid.cells("0R"), AntDraw::start_cell, AntDraw::start);
            move_start(environment, {std::max(start[0], 0.0), std::max(start[1], 0.0)});
        }
        const MazePlan plan(grid, ant_cell_of(goal[0], goal[1]));
        CollectedRows<float> rows;
        const auto step = [&](uint32_t t) {
            const std::vector<double>& o = environment.observation;
            append_all(rows.observations, o);
            const auto scatter = [&](uint32_t i) { return random.uniform(episode, t, AntDraw::waypoint + i); };
            see_from(heading_to_goal(plan, {o[0], o[1]}, goal, {scatter(0), scatter(1)}), o, seen.data());
            std::vector<float> action = sac::act(tape, walker, seen.data(), no_noise).first;
            for (uint32_t i = 0; i < 8; ++i) {
                const float noise = static_cast<float>(ant_noise) * random.normal(episode, t, AntDraw::noise + i);
                action[i] = std::clamp(action[i] + noise, -1.0f, 1.0f);
            }
            append_all(rows.actions, action);
            environment.step(action.data(), state.data());
            rows.timeouts.push_back(t == static_cast<uint32_t>(task.max_episode_steps));
            append_all(rows.goal, goal);
            append_all(rows.qpos, qpos);
            append_all(rows.qvel, qvel);
        };
        try {
            for (int t = 0; t <= task.max_episode_steps && set.length() + rows.length() < steps; ++t) step(t);
            set.append(rows);
        } catch (const Error& error) {
            if (error.id != "environment.unstable") throw;
        }
        if (progress) progress(set.length());
    }
    environment.reset(resets, data_set_episodes - 1, state.data());  // the goal of an episode that is not in the set
    relabel(set, environment.goal, diverse);
    return set;
}

#endif  // WODTEM_MUJOCO
