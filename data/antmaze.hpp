// antmaze.hpp: how D4RL made its antmaze data, for whoever makes such data again: an ant that walks in a commanded
// direction, a planner on the maze's cells that commands it, and rewards written in afterwards.
//
//   walker       WalkingAnt is the task that sac.hpp learns to walk by; data/policies has what it learned
//   planner      breadth-first from the goal's cell: for each cell the next one
//   data set     8 arrays of a row per step, those of D4RL's files
//
// Promises: a data set is a function of (task, steps, seed, policy, machine), fewer steps are its beginning but for the
// last row's reward. Where D4RL's released script leaves open what was done, the choice is said at AntMazeSet.
// Leaves out: numpy's random numbers; files (collect.hpp); how the policy is trained (collect.hpp, sac.hpp).
#pragma once

#include <array>
#include <cmath>
#include <functional>
#include <numbers>
#include <string_view>
#include <utility>
#include <vector>

#include "../mujoco_env.hpp"
#include "sac.hpp"

// ---------------------------------------------------------------------------------------------------------------------
// The planner. Cells are the characters of the map; x runs along columns, and D4RL counts a position to the column
// 1 + floor(x / 4), so a cell begins at its own centre: the ant turns to the next way-point where it has reached one.

constexpr double ant_cell = 4;  // m

inline MazeCell ant_cell_of(double x, double y) {
    const auto index = [](double at) { return 1 + static_cast<int>(std::floor(std::max(at, 1e-4) / ant_cell)); };
    return {index(y), index(x)};
}
inline std::array<double, 2> ant_cell_centre(MazeCell cell) {
    return {ant_cell * (cell.column - 1), ant_cell * (cell.row - 1)};  // x, y
}

struct AntPlan {
    int rows = 0, columns = 0;
    std::vector<MazeCell> next;  // [rows * columns] towards the goal; the goal's own is itself; {-1, -1}: no way

    // Breadth-first from the goal, neighbours left, right, down, up; the first to reach a cell is its next. A cell in a
    // wall is reached but not passed: an ant that leans over a wall's corner still finds out.
    AntPlan(std::string_view map, MazeCell goal) {
        std::vector<std::string_view> lines;
        for (size_t at = 0; at < map.size(); at += lines.back().size() + 1)
            lines.push_back(map.substr(at, map.find('/', at) - at));
        rows = static_cast<int>(lines.size()), columns = static_cast<int>(lines[0].size());
        next.assign(static_cast<size_t>(rows * columns), {-1, -1});
        next[number(goal)] = goal;
        std::vector<MazeCell> queue = {goal};
        for (size_t i = 0; i < queue.size(); ++i) {
            const MazeCell at = queue[i];
            for (const MazeCell move : {MazeCell{0, -1}, {0, 1}, {1, 0}, {-1, 0}}) {
                const MazeCell to = {at.row + move.row, at.column + move.column};
                if (!contains(to) || next[number(to)].row >= 0) continue;
                next[number(to)] = at;
                if (lines[static_cast<size_t>(to.row)][static_cast<size_t>(to.column)] != '1') queue.push_back(to);
            }
        }
    }
    bool contains(MazeCell cell) const {
        return cell.row >= 0 && cell.row < rows && cell.column >= 0 && cell.column < columns;
    }
    size_t number(MazeCell cell) const { return static_cast<size_t>(cell.row * columns + cell.column); }
};

// ---------------------------------------------------------------------------------------------------------------------
// The walker.

constexpr const char* walker_name = "antmaze-walker";

#ifdef WODTEM_MUJOCO

constexpr int walking_ant_state = 27;

// What the walker sees, [27]: the observation without x and y, as it is in a frame whose x axis is the commanded
// direction: `heading`, rad, from the world's x axis. Departs from D4RL's walker, which is given the 27 numbers and
// the direction as two more: the floor looks the same from all sides, so what was learned for one direction holds for all.
// q and -q are one rotation; the one with w >= 0 is seen.
inline void see_from(double heading, std::span<const double> observation, float* seen) {
    const double c = std::cos(heading), s = std::sin(heading);
    const double turn_w = std::cos(heading / 2),
                 turn_z = -std::sin(heading / 2);  // the quaternion of a turn by -heading
    const double w = observation[3], x = observation[4], y = observation[5], z = observation[6];
    const double vx = observation[15], vy = observation[16];
    for (size_t i = 0; i < walking_ant_state; ++i) seen[i] = static_cast<float>(observation[2 + i]);
    const std::array<double, 4> turned = {turn_w * w - turn_z * z, turn_w * x - turn_z * y, turn_w * y + turn_z * x,
                                          turn_w * z + turn_z * w};
    for (size_t i = 0; i < 4; ++i) seen[1 + i] = static_cast<float>(turned[0] < 0 ? -turned[i] : turned[i]);
    seen[13] = static_cast<float>(c * vx + s * vy), seen[14] = static_cast<float>(c * vy - s * vx);
}

// antmaze's ant where no wall is, paid for its speed (m/s) in a direction that is drawn anew every 50 steps. An episode
// ends when the ant falls: its torso leaves the heights that gym's ant allows, or tilts by more than 90 degrees.
struct WalkingAnt {
    static constexpr int steps_per_direction = 50, max_episode_steps = 500;
    static constexpr double away = 100;          // m, from the maze along x and y
    static constexpr uint32_t first_draw = 100;  // after those of the body's reset

    MujocoEnvironment body;
    Random random{0, Stream::environment};
    uint64_t episode = 0;
    double heading = 0;

    WalkingAnt() : body(*find_mujoco_task("antmaze-umaze"), Physics::d4rl) {}
    EnvironmentSpec spec() const { return {walking_ant_state, body.task->action_dim, 0, max_episode_steps}; }

    void reset(const Random& chance, uint64_t number, float* state) {
        random = chance, episode = number;
        std::vector<float> ignored(body.observation.size());
        body.reset(chance, number, ignored.data());
        const mjModel& model = *body.model;
        std::vector<double> qpos(body.data->qpos, body.data->qpos + model.nq),
            qvel(body.data->qvel, body.data->qvel + model.nv);
        qpos[0] += away, qpos[1] += away;
        body.start(qpos, qvel);
        choose_direction();
        see_from(heading, body.observation, state);
    }

    Step step(const float* action, float* state) {
        const double* qpos = body.data->qpos;
        const double x = qpos[0], y = qpos[1];
        std::vector<float> ignored(body.observation.size());
        body.step(action, ignored.data());
        const double speed = ((qpos[0] - x) * std::cos(heading) + (qpos[1] - y) * std::sin(heading)) / body.step_time();
        // The torso's own z axis has the height 1 - 2 (qx^2 + qy^2).
        const bool upright = qpos[4] * qpos[4] + qpos[5] * qpos[5] < 0.5;
        const bool fallen = !(qpos[2] >= 0.2 && qpos[2] <= 1.0 && upright);
        if (body.steps % steps_per_direction == 0) choose_direction();
        see_from(heading, body.observation, state);
        return {speed, fallen};
    }

    void choose_direction() {
        heading = 2 * std::numbers::pi * random.uniform(episode, first_draw + static_cast<uint32_t>(body.steps));
    }
};

// ---------------------------------------------------------------------------------------------------------------------
// The data set.

// Row t: what was so before step t, that step's action, and (as in D4RL) infos/qpos and infos/qvel after it.
// Episodes end by the limit alone, and last 701 steps, because the script's test comes before its counter's increment;
// the ant goes on after success.
// The script leaves open, and here is chosen:
//   - antmaze-umaze: each episode goes to the goal that the environment draws at its reset, from the start cell.
//   - antmaze-umaze-diverse (multistart, multigoal: the script has the first alone): it starts in a free cell drawn
//     uniformly (the goal's counts as wall), plus uniform [0, 1) per coordinate, raised to at least 0, and goes to a
//     free cell (this time the goal's too) drawn alike, plus uniform [0, 1).
//   - the walker takes its mean action, to which the noise is added.
struct AntMazeSet {
    std::vector<float> observations, actions;  // [N, 29], [N, 8]
    std::vector<float> rewards, terminals;     // [N] 0 or 1; D4RL's relabelling script writes both as numbers
    std::vector<uint8_t> timeouts;             // [N]
    std::vector<float> goal, qpos, qvel;       // [N, 2] the episode's own, [N, 15], [N, 14]

    size_t length() const { return timeouts.size(); }
    void resize(size_t rows) {
        observations.resize(29 * rows), actions.resize(8 * rows), timeouts.resize(rows);
        goal.resize(2 * rows), qpos.resize(15 * rows), qvel.resize(14 * rows);
    }
};

constexpr double ant_noise = 0.2;  // of an action: times a standard normal; then clipped to [-1, 1]

// What is drawn from Stream::data_set; step: the episode, index: the time-step, site: one of these, + 1 for y after x.
namespace AntDraw {
constexpr uint32_t noise = 0;        // + action dimension
constexpr uint32_t waypoint = 8;     // scatter of the sub-goal
constexpr uint32_t start_cell = 10;  // index 0, here and below
constexpr uint32_t start = 11, goal_cell = 13, goal = 14;
}  // namespace AntDraw

// Each row's reward and terminal tell whether the next row's observation is within 0.5 m of one goal for all rows:
// across boundaries this looks into the next episode, as D4RL's script does. The last row has none after it: 0.
// `once`: of each run of ones the first alone stays, as is reported of umaze-diverse's file; umaze's has whole runs.
inline void relabel(AntMazeSet& set, std::array<double, 2> goal, bool once) {
    set.rewards.assign(set.length(), 0);
    bool inside = false;
    for (size_t row = 0; row + 1 < set.length(); ++row) {
        const float* next = &set.observations[29 * (row + 1)];
        const bool was = std::exchange(inside, std::hypot(next[0] - goal[0], next[1] - goal[1]) <= goal_radius);
        set.rewards[row] = inside && !(once && was);
    }
    set.terminals = set.rewards;
}

// The heading from the ant to the next cell's centre plus uniform [0, 1) per coordinate, drawn anew in every step, or to
// the goal where that is in the next cell.
inline double heading_to_goal(const AntPlan& plan, std::array<double, 2> at, std::array<double, 2> goal,
                              std::array<double, 2> scatter) {
    const MazeCell cell = ant_cell_of(at[0], at[1]), end = ant_cell_of(goal[0], goal[1]);
    // Off the map, or behind its outermost walls, there is no next cell: straight on to the goal.
    const MazeCell next = plan.contains(cell) ? plan.next[plan.number(cell)] : end;
    std::array<double, 2> aim = goal;
    if (next.row >= 0 && !(next.row == end.row && next.column == end.column))
        for (size_t i = 0; i < 2; ++i) aim[i] = ant_cell_centre(next)[i] + scatter[i];
    return std::atan2(aim[1] - at[1], aim[0] - at[0]);
}

// `progress` is told the rows made so far after every episode.
inline AntMazeSet collect_ant_maze_set(const MujocoTask& task, size_t steps, uint32_t seed, sac::Network<float>& walker,
                                       const std::function<void(size_t)>& progress = {}) {
    const bool diverse = std::string_view(task.name) == "antmaze-umaze-diverse";
    const Random random{seed, Stream::data_set}, resets{seed, Stream::environment};
    MujocoEnvironment environment(task, Physics::d4rl);
    Compute compute(best_kernel(), 1);
    Tape<float> tape(compute);
    AntMazeSet set;
    std::vector<float> state(29), seen(walking_ant_state), action(8);
    const std::vector<float> silence(8);
    const std::vector<MazeCell> free = cells_marked(task.maze, '0'), start = cells_marked(task.maze, 'R'),
                                end = cells_marked(task.maze, 'G');
    std::vector<MazeCell> starts = free, goals = free;
    starts.insert(starts.end(), start.begin(), start.end());
    goals.insert(goals.end(), start.begin(), start.end());
    goals.insert(goals.end(), end.begin(), end.end());
    const auto append = [](std::vector<float>& to, const auto* from, size_t count) {
        for (size_t i = 0; i < count; ++i) to.push_back(static_cast<float>(from[i]));
    };
    // A cell's centre plus uniform [0, 1).
    const auto place_in = [&](const std::vector<MazeCell>& cells, uint64_t episode, uint32_t cell, uint32_t place) {
        std::array<double, 2> at = ant_cell_centre(cells[random.below(cells.size(), episode, 0, cell)]);
        for (uint32_t i = 0; i < 2; ++i) at[i] += random.uniform(episode, 0, place + i);
        return at;
    };
    for (uint64_t episode = data_set_episodes; set.length() < steps; ++episode) {
        const size_t first = set.length();
        environment.reset(resets, episode, state.data());
        std::array<double, 2> goal = environment.goal;
        if (diverse) {
            goal = place_in(goals, episode, AntDraw::goal_cell, AntDraw::goal);
            const std::array<double, 2> from = place_in(starts, episode, AntDraw::start_cell, AntDraw::start);
            std::vector<double> qpos(environment.data->qpos, environment.data->qpos + 15),
                qvel(environment.data->qvel, environment.data->qvel + 14);
            for (size_t i = 0; i < 2; ++i) qpos[i] += std::max(from[i], 0.0);
            environment.start(qpos, qvel);
        }
        const AntPlan plan(task.maze, ant_cell_of(goal[0], goal[1]));
        try {
            for (uint32_t t = 0; t <= static_cast<uint32_t>(task.max_episode_steps) && set.length() < steps; ++t) {
                const std::vector<double>& o = environment.observation;
                append(set.observations, o.data(), 29);
                const auto scatter = [&](uint32_t i) { return random.uniform(episode, t, AntDraw::waypoint + i); };
                see_from(heading_to_goal(plan, {o[0], o[1]}, goal, {scatter(0), scatter(1)}), o, seen.data());
                sac::act(tape, walker, seen.data(), silence.data(), action.data());
                for (uint32_t i = 0; i < 8; ++i) {
                    const float noisy =
                        action[i] + static_cast<float>(ant_noise) * random.normal(episode, t, AntDraw::noise + i);
                    action[i] = std::clamp(noisy, -1.0f, 1.0f);
                }
                append(set.actions, action.data(), 8);
                set.timeouts.push_back(t == static_cast<uint32_t>(task.max_episode_steps));
                environment.step(action.data(), state.data());
                append(set.goal, goal.data(), 2);
                append(set.qpos, environment.data->qpos, 15);
                append(set.qvel, environment.data->qvel, 14);
            }
        } catch (const Error& error) {  // D4RL's collection threw such an episode away
            if (error.id != "mujoco.unstable") throw;
            set.resize(first);
        }
        if (progress) progress(set.length());
    }
    environment.reset(resets, data_set_episodes - 1, state.data());  // whose goal no episode has
    relabel(set, environment.goal, diverse);
    return set;
}

#endif  // WODTEM_MUJOCO
