// waypoints.hpp: how D4RL made its maze2d data: a planner on the maze's cells, a controller that follows the plan, and
// one long run from random target to random target, as in D4RL's generation script.
//
// Promises: a data set is a function of (task, steps, seed, machine); a shorter set is the beginning of a longer one;
// its actions lead through its observations bit by bit. Where D4RL's script and its published files differ, it agrees
// with the files (see collect_maze_data_set). The planner and the controller need no MuJoCo.
// Leaves out: numpy's random numbers, so a set agrees with D4RL's in distribution, not row by row; files.
#pragma once

#include "../mujoco_env.hpp"
#include "rows.hpp"

// ---------------------------------------------------------------------------------------------------------------------
// The grid model. Cells are the characters of the map; number of a cell: row + column * rows. Row is x, column is y.

constexpr std::array<MazeCell, 5> maze_moves{{{0, 0}, {0, -1}, {0, 1}, {-1, 0}, {1, 0}}};  // the order decides ties

struct MazeGrid {
    int rows = 0, columns = 0;
    std::vector<MazeCell> open;  // the cells that starts and targets are drawn from, D4RL's order: free ones, the goal
    std::vector<std::array<int, maze_moves.size()>> next;  // [rows * columns][move] where a move leads

    explicit MazeGrid(std::string_view map) : open(cells_marked(map, '0')) {
        columns = static_cast<int>(map.find('/'));
        rows = static_cast<int>(map.size()) / (columns + 1);
        append_all(open, cells_marked(map, 'G'));
        // A move into a wall or off the map stays in its cell. A plan may start in a wall: the ball comes as near as
        // 0.4 to a wall's centre, so its rounded position can be one, from which free neighbours can be entered.
        next.resize(rows * columns);
        for (int from = 0; from < rows * columns; ++from)
            for (size_t move = 0; move < maze_moves.size(); ++move) {
                const MazeCell to{cell(from).row + maze_moves[move].row, cell(from).column + maze_moves[move].column};
                const bool enters = contains(to.row, to.column) && map[to.row * (columns + 1) + to.column] != '1';
                next[from][move] = enters ? number(to) : from;
            }
    }

    int number(MazeCell cell) const { return cell.row + cell.column * rows; }
    MazeCell cell(int number) const { return {number % rows, number / rows}; }
    bool contains(double row, double column) const { return row >= 0 && row < rows && column >= 0 && column < columns; }
};

// ---------------------------------------------------------------------------------------------------------------------
// The planner.

using MazeValues = std::vector<std::array<double, maze_moves.size()>>;  // Q [rows * columns][move]

// Exactly 50 sweeps of Q(s, a) <- R(s) + 0.99 max_b Q(s'(s, a), b) from Q = 0, with R = 1 in the target and 0
// elsewhere. After k sweeps V_k = (1 - 0.99^k) / 0.01 in the target (by staying), and 0.99^d V_(k-d) d moves away: less
// with every move, so a greedy path of up to 49 moves is a shortest one. Cells of equal distance have equal values.
inline MazeValues maze_values(const MazeGrid& grid, int target) {
    MazeValues q(grid.next.size());
    std::vector<double> v(q.size());  // max_b Q(s, b) of the sweep before
    for (int sweep = 0; sweep < 50; ++sweep) {
        for (size_t s = 0; s < q.size(); ++s) v[s] = std::ranges::max(q[s]);
        for (size_t s = 0; s < q.size(); ++s)
            for (size_t move = 0; move < maze_moves.size(); ++move)
                q[s][move] = (static_cast<int>(s) == target ? 1.0 : 0.0) + 0.99 * v[grid.next[s][move]];
    }
    return q;
}

// The cell after each greedy move (ties: the lowest move), up to the target. At least one move is made, so from the
// target itself the path is the target. If no path leads to the target, it is 100 times the start.
inline std::vector<int> greedy_path(const MazeGrid& grid, const MazeValues& q, int start, int target) {
    std::vector<int> path;
    int cell = start;
    do {
        const auto best = std::ranges::max_element(q[cell]) - q[cell].begin();  // the first of equals
        cell = grid.next[cell][best];
        path.push_back(cell);
    } while (cell != target && path.size() < 100);
    return path;
}

// ---------------------------------------------------------------------------------------------------------------------
// The controller. Positions in observed coordinates, m; velocities in m/s.

using MazePoint = std::array<double, 2>;  // x, y

inline double maze_distance(MazePoint a, MazePoint b) { return std::hypot(a[0] - b[0], a[1] - b[1]); }
inline MazePoint whole_point(MazeCell cell) { return {double(cell.row), double(cell.column)}; }

// Returns the point plus uniform [low, low + width) per coordinate. `site`: of the draw for x; the next one is for y.
inline MazePoint scattered(MazePoint point, double low, double width, const Random& random, uint64_t step,
                           uint32_t index, uint32_t site) {
    for (uint32_t i = 0; i < 2; ++i) point[i] += low + width * random.uniform(step, index, site + i);
    return point;
}

// The sites of the draws from Stream::data_set: each stands for x, and the next number for y.
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
    std::vector<MazeValues> values;  // [rows * columns] Q of each target, empty until it is first needed
    std::optional<MazeCell> target;  // none before the first call, which therefore plans
    std::vector<MazePoint> waypoints;
    size_t at = 0;         // the index of the present way-point
    MazePoint previous{};  // position of the last call

    WaypointController(const MazeGrid& maze, const Random& chance)
        : grid(maze),
          random(chance),
          values(maze.next.size()) {}

    // The force at a position and velocity towards a target, whose cell alone matters. Plans if the cell is a new one.
    WaypointAction act(MazePoint position, MazePoint velocity, MazePoint wanted) {
        const MazeCell to = cell_of(wanted);
        if (!target || target->row != to.row || target->column != to.column) plan(position, to);
        const double distance = maze_distance(position, whole_point(to)), speed = maze_distance(position, previous);
        const bool solved = distance < near && speed < slow;
        const MazePoint aim = solved ? whole_point(to) : waypoints[at];
        WaypointAction action{{}, solved};
        for (size_t i = 0; i < 2; ++i)
            action.force[i] =
                std::clamp(position_gain * (aim[i] - position[i]) + velocity_gain * velocity[i], -1.0, 1.0);
        // Takes effect at the next call. The last way-point is never passed: it is the target's, or one in a wall.
        if (!solved && maze_distance(position, aim) < near && speed < slow && at + 1 < waypoints.size()) ++at;
        previous = position;
        return action;
    }

    // Plans from the cell of `position`. The target's way-point is its cell, each other one is its cell minus uniform
    // [0, 0.2): on average half the way from the whole numbers to the corridor's middle, which is at -0.2.
    void plan(MazePoint position, MazeCell to) {
        const int start = grid.number(cell_of(position)), end = grid.number(to);
        MazeValues& q = values[end];
        if (q.empty()) q = maze_values(grid, end);
        waypoints.clear();
        for (const int cell : greedy_path(grid, q, start, end)) {
            const MazePoint centre = whole_point(grid.cell(cell));
            const uint32_t move = static_cast<uint32_t>(waypoints.size());
            waypoints.push_back(cell == end ? centre
                                            : scattered(centre, 0, -scatter, random, plans, move, MazeDraw::waypoint));
        }
        at = 0;
        target = to;
        previous = whole_point(grid.cell(start));  // as D4RL's; the first call's speed is then no real speed
        ++plans;
    }

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

// Target `number`: a free cell or the goal's, plus uniform [-0.1, 0.1) per coordinate.
inline MazePoint draw_maze_target(const MazeGrid& grid, const Random& random, uint64_t number) {
    const MazeCell cell = grid.open[random.below(grid.open.size(), number, 0, MazeDraw::target_cell)];
    return scattered(whole_point(cell), -0.1, 0.2, random, number, 0, MazeDraw::target_place);
}

// With --noisy D4RL's script adds this times a standard normal to every action and clips again. The published files'
// names do not say "noisy", but maze2d-umaze-v1 has 12459 timeouts in 10^6 rows. Over six seeds (mean, standard
// deviation) this loop makes 12426, 84 with the noise and 13626, 65 without.
constexpr double published_noise = 0.5;

// One run of `steps` steps; the body is never put back. (No episode of play(): its target changes, and it has no time
// limit.) Row t has the state before step t and that step's action in [-1, 1]; goal: the controller's target.
//   - timeouts: as in D4RL's published files 1 where a target was reached or given up and the next one drawn, and all
//     terminals 0. (The script writes these marks into terminals and has no timeouts.)
//   - After such a row the script does not read the new observation, so the controller acts once more on the old one
//     and the row repeats it, while infos/qpos is of the next step. Such rows serve no learner: here none is repeated.
//   - rewards are of the row's own observation, as in the published files; the environment pays for the next one.
// The published sets have 10^6 (umaze), 2 * 10^6 (medium) and 4 * 10^6 (large) steps. `progress` gets the number of
// steps made so far after every 10000. Errors: waypoints.not_maze2d, and those of the environment.
inline CollectedRows<float> collect_maze_data_set(const MujocoTask& task, size_t steps, uint32_t seed,
                                                  const std::function<void(size_t)>& progress = {},
                                                  double noise = published_noise) {
    const Random random{seed, Stream::data_set};
    const MazeGrid grid = maze2d_grid(task);
    WaypointController controller(grid, random);
    MujocoEnvironment environment(task, Physics::d4rl);
    CollectedRows<float> rows;
    std::array<float, 4> state;
    environment.reset(Random{seed, Stream::environment}, data_set_episodes, state.data());
    uint64_t targets = 0;
    MazePoint target = draw_maze_target(grid, random, targets++);
    int since_target = 0;  // steps made under this target
    while (rows.length() < steps) {
        const std::vector<double>& o = environment.observation;
        WaypointAction chosen = controller.act({o[0], o[1]}, {o[2], o[3]}, target);
        const bool next_target = chosen.solved || since_target >= task.max_episode_steps;
        for (uint32_t i = 0; i < 2; ++i) {
            const double normal = random.normal(rows.length(), 0, MazeDraw::noise + i);
            chosen.force[i] = std::clamp(chosen.force[i] + noise * normal, -1.0, 1.0);
        }
        append_all(rows.observations, state);
        append_all(rows.actions, chosen.force);
        const double distance = std::hypot(state[0] - environment.goal[0], state[1] - environment.goal[1]);
        rows.rewards.push_back(distance <= goal_radius);
        rows.terminals.push_back(0);
        rows.timeouts.push_back(next_target);
        append_all(rows.goal, target);
        append_all(rows.qpos, std::span(environment.data->qpos, 2));
        append_all(rows.qvel, std::span(environment.data->qvel, 2));

        // departs from D4RL's script, which steps with the action in double: the recorded one leads to the next row.
        environment.step(&rows.actions[rows.actions.size() - 2], state.data());
        ++since_target;
        if (next_target) {
            target = draw_maze_target(grid, random, targets++);
            since_target = 0;
        }
        if (progress && rows.length() % 10000 == 0) progress(rows.length());
    }
    return rows;
}

#endif  // WODTEM_MUJOCO
