// waypoints.hpp: how D4RL made its maze2d data: a planner on the maze's cells, a controller that follows the plan, and
// one long run from random target to random target, as in D4RL's generation script.
//
//   planner      50 sweeps of Q <- R + 0.99 max Q on the cells, then greedy moves: a way-point for each cell entered
//   controller   pushes at the present way-point: 10 (aim - position) - velocity, clipped to [-1, 1]
//   data set     8 arrays of a row per step, those of D4RL's files; the run's targets are not the task's goal
//
// Promises: a data set is a function of (task, steps, seed, machine), fewer steps are its beginning, and its actions
// given back to the environment lead through its observations bit by bit; where D4RL's script and its published files
// differ, it has the files' form (see MazeDataSet).
// Leaves out: numpy's random numbers, so a set agrees with D4RL's in distribution, not row by row; files.
// The planner and the controller need no MuJoCo.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <functional>
#include <optional>
#include <string_view>
#include <utility>
#include <vector>

#include "../gridworld.hpp"
#include "../mujoco_env.hpp"
#include "../nn.hpp"

// ---------------------------------------------------------------------------------------------------------------------
// The grid model. Cells are the characters of the map; number of a cell: row + column * rows. Row is x, column is y.

constexpr std::array<MazeCell, 5> maze_moves{{{0, 0}, {0, -1}, {0, 1}, {-1, 0}, {1, 0}}};  // the order decides ties

struct MazeGrid {
    int rows = 0, columns = 0;
    std::vector<MazeCell> open;  // the cells that starts and targets are drawn from, D4RL's order: free ones, the goal
    std::vector<std::array<int, maze_moves.size()>> next;  // [rows * columns][move] where a move leads

    explicit MazeGrid(std::string_view map) {
        for (const MazeCell cell : cells_marked(map, '1')) {  // the outermost cells are walls
            rows = std::max(rows, cell.row + 1);
            columns = std::max(columns, cell.column + 1);
        }
        open = cells_marked(map, '0');
        for (const MazeCell goal : cells_marked(map, 'G')) open.push_back(goal);
        std::vector<bool> enterable(static_cast<size_t>(rows * columns));
        for (const MazeCell cell : open) enterable[static_cast<size_t>(number(cell))] = true;
        // A move into a wall or off the map stays put. A plan may start in a wall: the ball's centre comes as near as
        // 0.4 to a wall cell's number, so its rounded position can be one; from there free neighbours can be entered.
        next.resize(enterable.size());
        for (int from = 0; from < rows * columns; ++from) {
            for (size_t move = 0; move < maze_moves.size(); ++move) {
                const MazeCell to{cell(from).row + maze_moves[move].row, cell(from).column + maze_moves[move].column};
                const bool enters = contains(to.row, to.column) && enterable[static_cast<size_t>(number(to))];
                next[static_cast<size_t>(from)][move] = enters ? number(to) : from;
            }
        }
    }

    int number(MazeCell cell) const { return cell.row + cell.column * rows; }
    MazeCell cell(int number) const { return {number % rows, number / rows}; }
    bool contains(double row, double column) const { return row >= 0 && row < rows && column >= 0 && column < columns; }
};

// ---------------------------------------------------------------------------------------------------------------------
// The planner.

constexpr int planner_sweeps = 50;
constexpr double planner_discount = 0.99;
constexpr int planner_moves = 100;  // at most, in a plan

using MazeValues = std::vector<std::array<double, maze_moves.size()>>;  // Q [rows * columns][move]

// Exactly 50 sweeps of Q(s, a) <- R(s) + 0.99 max_b Q(s'(s, a), b) from Q = 0, with R(s) = 1 in the target and 0
// elsewhere: paid for the state one is in, not for the one entered. In the target k sweeps give
// V_k = 1 + 0.99 V_(k-1) = (1 - 0.99^k) / 0.01 (by staying), and d moves away 0.99^d V_(k-d): strictly less with every
// move, so up to 49 moves the greedy path is a shortest one. Ties are exact: equal distances, equal operations.
inline MazeValues maze_values(const MazeGrid& grid, int target) {
    MazeValues q(grid.next.size());
    std::vector<double> v(q.size());  // max_b Q(s, b) of the sweep before
    for (int sweep = 0; sweep < planner_sweeps; ++sweep) {
        for (size_t s = 0; s < q.size(); ++s) v[s] = *std::max_element(q[s].begin(), q[s].end());
        for (size_t s = 0; s < q.size(); ++s)
            for (size_t move = 0; move < maze_moves.size(); ++move)
                q[s][move] = (static_cast<int>(s) == target ? 1.0 : 0.0) +
                             planner_discount * v[static_cast<size_t>(grid.next[s][move])];
    }
    return q;
}

// The cell after each greedy move (ties: the lowest number), up to the target. At least one move is made, so from the
// target itself the path is the target. Where no way leads to the target it is 100 times where one stands.
inline std::vector<int> greedy_path(const MazeGrid& grid, const MazeValues& q, int start, int target) {
    std::vector<int> path;
    for (int cell = start; static_cast<int>(path.size()) < planner_moves;) {
        const auto& values = q[static_cast<size_t>(cell)];
        const auto best = std::max_element(values.begin(), values.end()) - values.begin();  // the first of equals
        path.push_back(cell = grid.next[static_cast<size_t>(cell)][static_cast<size_t>(best)]);
        if (cell == target) break;
    }
    return path;
}

// ---------------------------------------------------------------------------------------------------------------------
// The controller. Positions in observed coordinates, m; velocities in m/s.

using MazePoint = std::array<double, 2>;  // x, y

inline double maze_distance(MazePoint a, MazePoint b) { return std::hypot(a[0] - b[0], a[1] - b[1]); }
inline MazePoint whole_point(MazeCell cell) {
    return {static_cast<double>(cell.row), static_cast<double>(cell.column)};
}

// What is drawn from Stream::data_set, told apart by the site; + 1 is for y, each after its x.
namespace MazeDraw {
constexpr uint32_t waypoint = 0;     // step: number of the plan; index: move of the plan
constexpr uint32_t target_cell = 2;  // step: number of the target; index 0, here and below
constexpr uint32_t target_place = 3;
constexpr uint32_t noise = 5;  // step: row of the data set
}  // namespace MazeDraw

struct WaypointAction {
    MazePoint force;  // in [-1, 1]
    bool solved;      // at the target's cell, as far as the controller can tell
};

struct WaypointController {
    static constexpr double near = 0.1;     // m
    static constexpr double slow = 0.1;     // m per step of 0.01 s, that is 10 m/s: nearly always kept
    static constexpr double scatter = 0.2;  // m, of way-points
    static constexpr double position_gain = 10, velocity_gain = -1;

    MazeGrid grid;
    Random random;                   // site: MazeDraw::waypoint
    uint64_t plans = 0;              // made so far
    std::vector<MazeValues> values;  // [rows * columns] a target's Q, empty until it is needed; 4 KiB at most
    std::optional<MazeCell> target;  // none before the first call: any target is new
    std::vector<MazePoint> waypoints;
    size_t at = 0;         // the present way-point
    MazePoint previous{};  // position of the last call

    WaypointController(const MazeGrid& maze, const Random& chance)
        : grid(maze),
          random(chance),
          values(maze.next.size()) {}

    WaypointAction act(MazePoint position, MazePoint velocity, MazePoint wanted) {
        const MazeCell to = cell_of(wanted);
        if (!target || target->row != to.row || target->column != to.column) plan(position, to);
        // Against the target's cell, whole numbers: where in the cell the target lies makes no difference.
        const double distance = maze_distance(position, whole_point(to)), speed = maze_distance(position, previous);
        const bool solved = distance < near && speed < slow;
        const MazePoint aim = solved ? whole_point(to) : waypoints[at];
        WaypointAction action{{}, solved};
        for (size_t i = 0; i < 2; ++i)
            action.force[i] =
                std::clamp(position_gain * (aim[i] - position[i]) + velocity_gain * velocity[i], -1.0, 1.0);
        // Takes effect at the next call. Never beyond the last way-point: that is the target, where this is `solved`,
        // or a place in the wall out of reach.
        if (!solved && maze_distance(position, aim) < near && speed < slow && at + 1 < waypoints.size()) ++at;
        previous = position;
        return action;
    }

    // From the cell that `position` is rounded to. The target's way-point is exact, each other one is its cell minus
    // uniform [0, 0.2): on average half the way from the whole numbers to the corridor's middle, which is at -0.2.
    void plan(MazePoint position, MazeCell to) {
        const int start = grid.number(cell_of(position)), end = grid.number(to);
        MazeValues& q = values[static_cast<size_t>(end)];
        if (q.empty()) q = maze_values(grid, end);
        waypoints.clear();
        for (const int cell : greedy_path(grid, q, start, end)) {
            MazePoint point = whole_point(grid.cell(cell));
            for (uint32_t i = 0; i < 2 && cell != end; ++i)
                point[i] -=
                    scatter * random.uniform(plans, static_cast<uint32_t>(waypoints.size()), MazeDraw::waypoint + i);
            waypoints.push_back(point);
        }
        at = 0;
        target = to;
        previous = whole_point(grid.cell(start));  // so speed means little at the first call
        ++plans;
    }

    void forget() { target.reset(); }  // the next call plans anew

    // The nearest cell, halves to the even one. Errors: waypoints.off_map.
    MazeCell cell_of(MazePoint point) const {
        const double row = std::nearbyint(point[0]), column = std::nearbyint(point[1]);
        if (!grid.contains(row, column))
            fail("waypoints.off_map", "(%g, %g) is not on the map of %d x %d cells", point[0], point[1], grid.rows,
                 grid.columns);
        return {static_cast<int>(row), static_cast<int>(column)};
    }
};

// Errors: waypoints.not_maze2d.
inline MazeGrid maze2d_grid(const MujocoTask& task) {
    if (task.rules != Rules::maze2d)
        fail("waypoints.not_maze2d", "the way-point controller drives maze2d tasks, not %s", task.name);
    return MazeGrid(task.maze);
}

#ifdef WODTEM_MUJOCO

// ---------------------------------------------------------------------------------------------------------------------
// The data set.

// One run of N steps; the body is never put back. Row t is what was so before step t, and that step's action.
//   - timeouts: D4RL's published files have all terminals 0, and timeouts 1 where a target was reached or given up and
//     the next one drawn. (The script writes these marks into terminals and has no timeouts.)
//   - After such a row the script does not take over the new observation, so the controller acts once more on the old
//     one and the row repeats it, while infos/qpos has moved on. Nobody has said that the published files show this,
//     and observations that belong to another time than their actions serve no learner: here no row is repeated.
//   - rewards are of the row's own observation, as in the published files; the environment pays for the next one.
struct MazeDataSet {
    std::vector<float> observations;  // [N, 4] x, y, vx, vy
    std::vector<float> actions;       // [N, 2] in [-1, 1]
    std::vector<float> rewards;       // [N] 1 within 0.5 of the map's goal, else 0
    std::vector<float> terminals;     // [N] 0
    std::vector<float> timeouts;      // [N] 0 or 1
    std::vector<float> goal;          // [N, 2] infos/goal: the target the controller was given; not the map's goal
    std::vector<float> qpos, qvel;    // [N, 2] infos/qpos, infos/qvel; in maze2d the observation's two halves

    size_t length() const { return rewards.size(); }
};

// Target `number`: a free cell or the goal's, plus uniform [-0.1, 0.1).
inline MazePoint draw_maze_target(const MazeGrid& grid, const Random& random, uint64_t number) {
    MazePoint target = whole_point(grid.open[random.below(grid.open.size(), number, 0, MazeDraw::target_cell)]);
    for (uint32_t i = 0; i < 2; ++i) target[i] += 0.2 * random.uniform(number, 0, MazeDraw::target_place + i) - 0.1;
    return target;
}

// The script adds this times a standard normal to every action when it is run with --noisy, and clips again. The names
// of the published files do not say "noisy", but one of them was counted: maze2d-umaze-v1 has 12459 timeouts in 10^6
// rows. Over six seeds (mean, standard deviation) this loop makes 12426, 84 with the noise and 13626, 65 without.
constexpr double published_noise = 0.5;

// The published sets have 10^6 (umaze), 2 * 10^6 (medium) and 4 * 10^6 (large) steps. `progress` is told the steps made
// so far after every 10000.
// Errors: waypoints.not_maze2d, and what the environment may say.
inline MazeDataSet collect_maze_data_set(const MujocoTask& task, size_t steps, uint32_t seed,
                                         const std::function<void(size_t)>& progress = {},
                                         double noise = published_noise) {
    const Random random{seed, Stream::data_set};
    const MazeGrid grid = maze2d_grid(task);
    WaypointController controller(grid, random);
    MujocoEnvironment environment(task, Physics::d4rl);
    MazeDataSet set;
    for (auto* one : {&set.rewards, &set.terminals, &set.timeouts}) one->reserve(steps);
    for (auto* two : {&set.actions, &set.goal, &set.qpos, &set.qvel}) two->reserve(2 * steps);
    set.observations.reserve(4 * steps);
    const auto append = [](std::vector<float>& to, const auto* from, size_t count) {
        for (size_t i = 0; i < count; ++i) to.push_back(static_cast<float>(from[i]));
    };

    std::array<float, 4> state;
    environment.reset(Random{seed, Stream::environment}, data_set_episodes, state.data());
    uint64_t targets = 0;
    MazePoint target = draw_maze_target(grid, random, targets++);
    int since_target = 0;  // steps made under this target
    while (set.length() < steps) {
        const std::vector<double>& o = environment.observation;
        WaypointAction chosen = controller.act({o[0], o[1]}, {o[2], o[3]}, target);
        const bool give_up = since_target >= task.max_episode_steps;  // so 301, 601 or 801 rows at most
        const bool next_target = chosen.solved || give_up;
        for (uint32_t i = 0; i < 2; ++i) {
            const double normal = static_cast<double>(random.normal(set.length(), 0, MazeDraw::noise + i));
            chosen.force[i] = std::clamp(chosen.force[i] + noise * normal, -1.0, 1.0);
        }

        append(set.observations, state.data(), 4);
        append(set.actions, chosen.force.data(), 2);
        set.rewards.push_back(std::hypot(state[0] - environment.goal[0], state[1] - environment.goal[1]) <=
                              goal_radius);
        set.terminals.push_back(0);
        set.timeouts.push_back(next_target);
        append(set.goal, target.data(), 2);
        append(set.qpos, environment.data->qpos, 2);
        append(set.qvel, environment.data->qvel, 2);

        // departs from D4RL's script, which steps with the action in double: the recorded one leads to the next row.
        environment.step(&set.actions[set.actions.size() - 2], state.data());
        ++since_target;
        if (next_target) {
            target = draw_maze_target(grid, random, targets++);
            since_target = 0;
        }
        if (progress && set.length() % 10000 == 0) progress(set.length());
    }
    return set;
}

// ---------------------------------------------------------------------------------------------------------------------
// What the controller scores when it is sent to the task's own goal.

enum class Planning {
    every_episode,
    once,  // D4RL's reference scores: the target stays, so the plan of the first episode serves all, used up after it
};

// Undiscounted return of each episode. Episodes start as those of a data set do.
inline std::vector<double> controller_returns(const MujocoTask& task, Planning planning, int episodes, uint32_t seed) {
    WaypointController controller(maze2d_grid(task), Random{seed, Stream::data_set});
    MujocoEnvironment environment(task, Physics::d4rl);
    std::array<float, 4> state;
    std::vector<double> returns;
    for (int episode = 0; episode < episodes; ++episode) {
        environment.reset(Random{seed, Stream::environment}, data_set_episodes + static_cast<uint64_t>(episode),
                          state.data());
        if (planning == Planning::every_episode) controller.forget();
        returns.push_back(0);
        for (int t = 0; t < task.max_episode_steps; ++t) {
            const std::vector<double>& o = environment.observation;
            const MazePoint force = controller.act({o[0], o[1]}, {o[2], o[3]}, environment.goal).force;
            returns.back() += environment.advance(force).reward;
        }
    }
    return returns;
}

#endif  // WODTEM_MUJOCO
