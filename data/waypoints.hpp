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
// The planner. In maze2d a cell's row is x and its column is y, in antmaze the other way round.

// The shortest ways to a target, breadth first. They lead through no wall, but may start in one: the ball comes as near
// as 0.4 to a wall's centre, so its rounded position can be one, and the ant's torso may be over a wall's corner.
struct MazePlan {
    static constexpr int no_way = std::numeric_limits<int>::max();
    MazeGrid grid;
    std::vector<int> distance;   // [cell] moves to the target, or no_way
    std::vector<MazeCell> next;  // [cell] where the first move leads; the target's is itself; {-1, -1}: no way

    // Of the ways that are equally short `next` takes the first found, neighbours in the order left, right, down, up.
    MazePlan(const MazeGrid& maze, MazeCell target)
        : grid(maze),
          distance(maze.rows * maze.columns, no_way),
          next(distance.size(), {-1, -1}) {
        std::vector<MazeCell> queue = {target};
        distance[grid.number(target)] = 0;
        next[grid.number(target)] = target;
        for (size_t i = 0; i < queue.size(); ++i) {
            const MazeCell at = queue[i];
            if (!grid.can_enter(at)) continue;
            for (const MazeCell move : {MazeCell{0, -1}, {0, 1}, {1, 0}, {-1, 0}}) {
                const MazeCell to = {at.row + move.row, at.column + move.column};
                if (!grid.contains(to.row, to.column) || distance[grid.number(to)] != no_way) continue;
                distance[grid.number(to)] = distance[grid.number(at)] + 1;
                next[grid.number(to)] = at;
                queue.push_back(to);
            }
        }
    }

    // The cell after each move of maze2d's plan, up to the target; of the moves that come nearer the first in the order
    // left, right, up, down. At least one move is made, so from the target itself the path is the target. If no way
    // leads to the target, it is 100 times the start.
    // D4RL follows the largest Q after exactly 50 sweeps of Q(s, a) <- R(s) + 0.99 max_b Q(s'(s, a), b) from Q = 0,
    // with R = 1 in the target and 0 elsewhere; of equals the first, in this order behind staying. Cells of equal
    // distance have equal values and nearer ones greater, up to 49 moves: the same path. The tests compare the two.
    std::vector<MazeCell> path(MazeCell at) const {
        std::vector<MazeCell> cells;
        do {
            MazeCell nearest = at;
            for (const MazeCell move : {MazeCell{0, -1}, {0, 1}, {-1, 0}, {1, 0}}) {
                const MazeCell to = {at.row + move.row, at.column + move.column};
                if (grid.can_enter(to) && distance[grid.number(to)] < distance[grid.number(nearest)]) nearest = to;
            }
            cells.push_back(at = nearest);
        } while (distance[grid.number(at)] > 0 && cells.size() < 100);
        return cells;
    }
};

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
    Random random;                        // site: MazeDraw::waypoint
    uint64_t plans = 0;                   // made so far
    std::optional<MazeCell> target = {};  // none before the first call, which therefore plans
    std::vector<MazePoint> waypoints = {};
    size_t at = 0;            // the index of the present way-point
    MazePoint previous = {};  // position of the last call

    // The force at a position and velocity towards a target, whose cell alone matters. Plans if the cell is a new one.
    WaypointAction act(MazePoint position, MazePoint velocity, MazePoint wanted) {
        const MazeCell to = cell_of(wanted);
        if (!target || grid.number(*target) != grid.number(to)) plan(position, to);
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
        const MazeCell start = cell_of(position);
        waypoints.clear();
        for (const MazeCell cell : MazePlan(grid, to).path(start)) {
            const MazePoint centre = whole_point(cell);
            const uint32_t move = static_cast<uint32_t>(waypoints.size());
            const bool last = grid.number(cell) == grid.number(to);
            waypoints.push_back(last ? centre
                                     : scattered(centre, 0, -scatter, random, plans, move, MazeDraw::waypoint));
        }
        at = 0;
        target = to;
        previous = whole_point(start);  // as D4RL's; the first call's speed is then no real speed
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
    return {task.maze};
}

#ifdef WODTEM_MUJOCO

// ---------------------------------------------------------------------------------------------------------------------
// The data set.

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
    const std::vector<MazeCell> open = grid.cells("0G");  // D4RL's order: free cells, the goal
    WaypointController controller{grid, random};
    MujocoEnvironment environment(task, Physics::d4rl);
    CollectedRows<float> rows;
    std::array<float, 4> state;
    environment.reset(Random{seed, Stream::environment}, data_set_episodes, state.data());
    const auto draw_target = [&](uint64_t number) {  // an open cell, plus uniform [-0.1, 0.1) per coordinate
        const MazeCell cell = open[random.below(open.size(), number, 0, MazeDraw::target_cell)];
        return scattered(whole_point(cell), -0.1, 0.2, random, number, 0, MazeDraw::target_place);
    };
    uint64_t targets = 1;  // drawn so far
    MazePoint target = draw_target(0);
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
            target = draw_target(targets++);
            since_target = 0;
        }
        if (progress && rows.length() % 10000 == 0) progress(rows.length());
    }
    return rows;
}

#endif  // WODTEM_MUJOCO
