// mujoco_env.hpp: the nine MuJoCo tasks of the paper: hopper, walker2d, halfcheetah, ant (gym -v2), maze2d (-v1) and
// antmaze (-v2), WODTEM sec. V-A. One table of tasks, then models, reset, step, observation, reward and termination,
// written once, as an Environment of memory.hpp.
//
// The models are data/*.xml, held in the binary; walls are made from the mazes' cell maps below. Lengths are in metres,
// times in seconds, angles in radians, and qpos and qvel are MuJoCo's vectors of positions and velocities.
// Promises: the numbers of the environments that D4RL's data and scores belong to, in either physics; an episode is a
// function of (seed, episode, actions, machine); a step that the engine warns of is an error, never data.
// Leaves out: the time limit, which play() counts; data sets; returns (memory.hpp); networks.
// Needs MuJoCo 2.2 (Debian: libmujoco-dev). Without it the table of tasks remains, and WODTEM_MUJOCO is not defined.
#pragma once

#include <optional>
#include <string_view>

#include "memory.hpp"  // and with it nn.hpp and the other standard headers

#if __has_include(<mujoco/mujoco.h>) && !defined(WODTEM_WITHOUT_MUJOCO)
#include <mujoco/mujoco.h>
#if mjVERSION_HEADER >= 220 && mjVERSION_HEADER < 230
#define WODTEM_MUJOCO
#endif
#endif

// ---------------------------------------------------------------------------------------------------------------------
// Mazes. 1: wall, 0: free, R: the ant's start, G: goal; rows from the top, each ended by a slash.

constexpr const char* umaze_map =
    "11111/"
    "1G001/"
    "11101/"
    "10001/"
    "11111/";
constexpr const char* medium_map =
    "11111111/"
    "10011001/"
    "10010001/"
    "11000111/"
    "10010001/"
    "10100101/"
    "100010G1/"
    "11111111/";
constexpr const char* large_map =
    "111111111111/"
    "100001000001/"
    "101101010101/"
    "100000010001/"
    "101111011101/"
    "100101000001/"
    "110101010111/"
    "100100010G01/"
    "111111111111/";
constexpr const char* ant_umaze_map =
    "11111/"
    "1R001/"
    "11101/"
    "1G001/"
    "11111/";

struct MazeCell {
    int row, column;
};

// The cells marked `mark`, in row-major order.
inline std::vector<MazeCell> cells_marked(std::string_view map, char mark) {
    std::vector<MazeCell> cells;
    MazeCell at{0, 0};
    for (const char c : map) {
        if (c == mark) cells.push_back(at);
        at = c == '/' ? MazeCell{at.row + 1, 0} : MazeCell{at.row, at.column + 1};
    }
    return cells;
}

// A grid of cells: the characters of a map.
struct MazeGrid {
    std::string_view map;
    int columns = static_cast<int>(map.find('/')), rows = static_cast<int>(map.size()) / (columns + 1);

    // Whether a place is on the map; NaN is not.
    bool contains(double row, double column) const { return row >= 0 && row < rows && column >= 0 && column < columns; }
    size_t number(MazeCell cell) const { return cell.row * columns + cell.column; }
    bool can_enter(MazeCell to) const {
        return contains(to.row, to.column) && map[to.row * (columns + 1) + to.column] != '1';
    }
    // The cells with one of the marks, mark by mark.
    std::vector<MazeCell> cells(std::string_view marks) const {
        std::vector<MazeCell> all;
        for (const char mark : marks)
            for (const MazeCell cell : cells_marked(map, mark)) all.push_back(cell);
        return all;
    }
};

// ---------------------------------------------------------------------------------------------------------------------
// The table of tasks.

enum class Rules { hopper, walker2d, halfcheetah, ant, maze2d, antmaze };

constexpr double no_limit = std::numeric_limits<double>::infinity();

struct MujocoTask {
    const char *name, *version;  // together the id: hopper-v2; D4RL's data sets put their level between the two
    Rules rules;
    const char* maze;  // map, or null
    int state_dim, action_dim;
    int first_position;     // the observation is qpos from here on, then qvel, then for ant the contact forces
    double velocity_limit;  // observed velocities are clipped to +- this
    int frame_skip;         // engine steps per action; each takes the model's time step
    int max_episode_steps;
    double control_cost;           // per squared unit of action
    double reset_noise;            // qpos at a reset: uniform within +- this of qpos0 (maze2d: of a cell)
    bool normal_velocity;          // qvel at a reset: this noise times a standard normal, else uniform as qpos
    double score_low, score_high;  // D4RL's reference returns: a random policy, and an expert
};

// Sources: gym 0.18.0's -v2 classes, D4RL's pointmaze and locomotion; reference returns: D4RL's infos.
constexpr std::array<MujocoTask, 9> mujoco_tasks{{
    {"hopper", "-v2", Rules::hopper, nullptr, 11, 3, 1, 10, 4, 1000, 0.001, 0.005, false, -20.272305, 3234.3},
    {"walker2d", "-v2", Rules::walker2d, nullptr, 17, 6, 1, 10, 4, 1000, 0.001, 0.005, false, 1.629008, 4592.3},
    {"halfcheetah", "-v2", Rules::halfcheetah, nullptr, 17, 6, 1, no_limit, 5, 1000, 0.1, 0.1, true, -280.178953,
     12135.0},
    {"ant", "-v2", Rules::ant, nullptr, 111, 8, 2, no_limit, 5, 1000, 0.5, 0.1, true, -325.6, 3879.7},
    {"maze2d-umaze", "-v1", Rules::maze2d, umaze_map, 4, 2, 0, no_limit, 1, 300, 0, 0.1, true, 23.85, 161.86},
    {"maze2d-medium", "-v1", Rules::maze2d, medium_map, 4, 2, 0, no_limit, 1, 600, 0, 0.1, true, 13.13, 277.39},
    {"maze2d-large", "-v1", Rules::maze2d, large_map, 4, 2, 0, no_limit, 1, 800, 0, 0.1, true, 6.7, 273.99},
    {"antmaze-umaze", "-v2", Rules::antmaze, ant_umaze_map, 29, 8, 0, no_limit, 5, 700, 0, 0.1, true, 0, 1},
    {"antmaze-umaze-diverse", "-v2", Rules::antmaze, ant_umaze_map, 29, 8, 0, no_limit, 5, 700, 0, 0.1, true, 0, 1},
}};

// The task that an id such as "hopper", "hopper-v2" or "hopper-medium-replay-v2" belongs to, or null.
constexpr const MujocoTask* find_mujoco_task(std::string_view id) {
    const MujocoTask* found = nullptr;  // antmaze-umaze-diverse comes after antmaze-umaze
    for (const MujocoTask& task : mujoco_tasks) {
        const std::string_view name = task.name;
        if (id.starts_with(name) && (id.size() == name.size() || id[name.size()] == '-')) found = &task;
    }
    return found;
}

// D4RL: 0 for a random policy, 100 for an expert; `total_return`: undiscounted, of an episode or a mean of several.
constexpr double normalised_score(const MujocoTask& task, double total_return) {
    return 100 * (total_return - task.score_low) / (task.score_high - task.score_low);
}

// D4RL: a goal is reached within this distance.
constexpr double goal_radius = 0.5;

// Observed x and y as place on the map: (row, column), whole numbers at the cells' centres, and the length of a cell.
// maze2d: x runs along rows of the map, and the body sits 1.2 from the origin of the walls, whose cells stand at
// (row + 1, column + 1). antmaze: x runs along columns, the start cell (1, 1) is the origin, a cell is 4 m long.
struct MazePlace {
    double row, column;
};
constexpr MazePlace maze_place(const MujocoTask& task, double x, double y) {
    if (task.rules == Rules::antmaze) return {y / 4 + 1, x / 4 + 1};
    return {x + 0.2, y + 0.2};
}
constexpr double maze_cell_length(const MujocoTask& task) { return task.rules == Rules::antmaze ? 4 : 1; }

// Where masses and inertias come from. D4RL's data were made with MuJoCo up to 2.1.0, which took a capsule for a
// cylinder; MuJoCo 2.1.1 and later compute it exactly, up to 7.7% heavier (walker2d's feet), and gym's v4 classes so.
enum class Physics { d4rl, mujoco_2_2 };
constexpr std::array<const char*, 2> physics_names{"d4rl", "2.2"};

constexpr const char* mujoco_advice = "apt-get install libmujoco-dev, then make clean and make";

#ifndef WODTEM_MUJOCO
inline std::string mujoco_version() { return "none"; }
#else
inline std::string mujoco_version() { return mj_versionString(); }

// ---------------------------------------------------------------------------------------------------------------------
// Models.

// Holds the bytes of a file in the binary: [name, name_end), followed by a zero. The compiler opens the path, from the
// folder it runs in.
#define WODTEM_EMBED(name, path)                                                                        \
    asm(".pushsection .rodata\n.weak " #name ", " #name "_end\n" #name ": .incbin \"" path "\"\n" #name \
        "_end: .byte 0\n.popsection\n");                                                                \
    extern "C" const char name[], name##_end[];
WODTEM_EMBED(wodtem_hopper_xml, "data/hopper.xml")
WODTEM_EMBED(wodtem_walker2d_xml, "data/walker2d.xml")
WODTEM_EMBED(wodtem_halfcheetah_xml, "data/halfcheetah.xml")
WODTEM_EMBED(wodtem_ant_xml, "data/ant.xml")
WODTEM_EMBED(wodtem_maze2d_xml, "data/maze2d.xml")

// Returns a file of data/*.xml; antmaze has gym's ant.
inline const char* embedded_model(Rules rules) {
    if (rules == Rules::hopper) return wodtem_hopper_xml;
    if (rules == Rules::walker2d) return wodtem_walker2d_xml;
    if (rules == Rules::maze2d) return wodtem_maze2d_xml;
    return rules == Rules::halfcheetah ? wodtem_halfcheetah_xml : wodtem_ant_xml;
}

// A box for each wall of the map, in row-major order. What stands still has margin 0, here and in data/*.xml, and what
// moves the original's: up to MuJoCo 3.4 a contact begins at the larger of two margins, later at their sum.
inline std::string maze_walls(const MujocoTask& task) {
    std::string xml;
    for (const auto [row, column] : cells_marked(task.maze, '1')) {
        char wall[200];
        if (task.rules == Rules::antmaze)
            std::snprintf(wall, sizeof wall,
                          R"(<geom type="box" pos="%d %d 1" size="2 2 1" conaffinity="1" margin="0"/>)",
                          4 * (column - 1), 4 * (row - 1));
        else
            std::snprintf(wall, sizeof wall, R"(<geom type="box" pos="%d %d 0" size="0.5 0.5 0.2" margin="0"/>)",
                          row + 1, column + 1);
        xml += wall;
    }
    return xml;
}

// The task's MJCF: a file of data/ and what the task or the physics changes in it. Later elements win.
inline std::string task_model(const MujocoTask& task, Physics physics) {
    std::string xml = "<mujoco><include file=\"model.xml\"/>";
    if (physics == Physics::mujoco_2_2) xml += R"(<compiler inertiafromgeom="true")";
    if (physics == Physics::mujoco_2_2) xml += task.rules == Rules::halfcheetah ? R"( settotalmass="14"/>)" : "/>";
    if (task.rules == Rules::antmaze)
        xml += R"(<option timestep="0.02"/>
            <default><geom solref="0.02 1" solimp="0.8 0.8 0.01"/><motor gear="1" ctrlrange="-30 30"/></default>)";
    if (task.maze) xml += "<worldbody>" + maze_walls(task) + "</worldbody>";
    return xml + "</mujoco>";
}

// Makes the engine's errors exceptions, and keeps it from printing warnings, whose counters check_engine() reads.
// The exception unwinds the engine's C functions, which C++ does not guarantee: it works where the library has unwind
// tables, as on x86-64 Linux. Memory that they had allocated leaks, and the interrupted simulation needs a start().
inline void silence_engine() {
    mju_user_error = [](const char* text) { fail("mujoco.engine", "MuJoCo: %s", text); };
    mju_user_warning = [](const char*) {};
}

// Compiles the task's model. Errors: mujoco.version, mujoco.model, mujoco.engine.
inline std::shared_ptr<const mjModel> load_model(const MujocoTask& task, Physics physics) {
    silence_engine();
    if (mj_version() != mjVERSION_HEADER)
        fail("mujoco.version", "this program was built with MuJoCo %d and finds the library of %d; build it again",
             mjVERSION_HEADER, mj_version());
    const auto files = std::make_unique<mjVFS>();  // two megabytes
    mj_defaultVFS(files.get());
    const auto add_file = [&](const char* name, std::string_view text) {
        mj_makeEmptyFileVFS(files.get(), name, static_cast<int>(text.size()));
        std::memcpy(files->filedata[mj_findFileVFS(files.get(), name)], text.data(), text.size());
    };
    add_file("task.xml", task_model(task, physics));
    add_file("model.xml", embedded_model(task.rules));
    char error[500] = "";
    mjModel* model = mj_loadXML("task.xml", files.get(), error, sizeof error);
    mj_deleteVFS(files.get());
    if (!model) fail("mujoco.model", "the model of %s does not compile: %s", task.name, error);
    return {model, [](const mjModel* m) { mj_deleteModel(const_cast<mjModel*>(m)); }};
}

using EngineState = std::unique_ptr<mjData, void (*)(mjData*)>;

// Takes over a state that the engine has just allocated. Errors: mujoco.memory.
inline EngineState own_state(mjData* data) {
    if (!data) fail("mujoco.memory", "no memory for the state of a simulation; play fewer episodes at once");
    return {data, mj_deleteData};
}

// ---------------------------------------------------------------------------------------------------------------------
// The environment.

struct MujocoEnvironment : Environment {
    const MujocoTask* task;
    std::shared_ptr<const mjModel> model;
    EngineState data;                 // changes during an episode, as do the next three
    std::array<double, 2> goal{};     // observed x, y; mazes only
    int steps = 0;                    // since the reset
    std::vector<double> observation;  // [state_dim] the present one
    std::vector<double> control;      // [action_dim] the actuators', of the latest step

    MujocoEnvironment(const MujocoTask& t, Physics physics)
        : task(&t),
          model(load_model(t, physics)),
          data(own_state(mj_makeData(model.get()))),
          observation(t.state_dim),
          control(t.action_dim) {
        goal = default_goal();
        start({model->qpos0, static_cast<size_t>(model->nq)}, std::vector<double>(model->nv));
    }
    MujocoEnvironment(const MujocoEnvironment& other)
        : Environment(),
          task(other.task),
          model(other.model),
          data(own_state(mj_copyData(nullptr, other.model.get(), other.data.get()))),
          goal(other.goal),
          steps(other.steps),
          observation(other.observation),
          control(other.control) {}

    EnvironmentSpec spec() const override { return {task->state_dim, task->action_dim, 0, task->max_episode_steps}; }

    // Begins an episode at a random state: a function of (random, episode). state [state_dim].
    // gym's and D4RL's distributions, in our own random numbers: draws are counted, qpos before qvel.
    void reset(const Random& random, uint64_t episode, float* state) override {
        uint32_t draws = 0;
        const auto uniform = [&](double low, double high) {
            return low + (high - low) * random.uniform(episode, draws++);
        };
        if (task->rules == Rules::antmaze) {
            // D4RL's antmaze-v2: the goal cell's centre, plus uniform [0, 1), plus uniform [0, 0.5), x before y each
            // time, then raised to at least 0.
            goal = default_goal();
            for (const double range : {1.0, 0.5})
                for (double& g : goal) g += uniform(0, range);
            for (double& g : goal) g = std::max(g, 0.0);
        }
        const double noise = task->reset_noise;
        std::vector<double> qpos(model->qpos0, model->qpos0 + model->nq), qvel(model->nv);
        if (task->rules == Rules::maze2d) {  // D4RL: a free cell, the goal's among them
            const std::vector<MazeCell> cells = MazeGrid{task->maze}.cells("0G");
            const MazeCell cell = cells[random.below(cells.size(), episode, draws++)];
            qpos = {static_cast<double>(cell.row), static_cast<double>(cell.column)};
        }
        for (double& q : qpos) q += uniform(-noise, noise);
        for (double& v : qvel)
            v = task->normal_velocity ? noise * static_cast<double>(random.normal(episode, draws++))
                                      : uniform(-noise, noise);
        start(qpos, qvel);
        std::copy(observation.begin(), observation.end(), state);  // to float
    }

    // Begins an episode at a given state, qpos [nq], qvel [nv].
    void start(std::span<const double> qpos, std::span<const double> qvel) {
        mj_resetData(model.get(), data.get());  // also the controls, the time, the solver's warm start and the warnings
        steps = 0;
        std::copy(qpos.begin(), qpos.end(), data->qpos);
        std::copy(qvel.begin(), qvel.end(), data->qvel);
        // As in gym's set_state: normalises quaternions in qpos, places the bodies, leaves the next step's warm start.
        mj_forward(model.get(), data.get());
        observe();
    }

    // action [action_dim], state [state_dim]: the one that follows. Rewards after termination mean nothing.
    // Errors: mujoco.bad_action, environment.unstable; the episode is over then.
    Step step(const float* action, float* state) override {
        std::copy(action, action + task->action_dim, control.begin());
        const Step result = advance(control);
        std::copy(observation.begin(), observation.end(), state);
        return result;
    }

    std::unique_ptr<Environment> clone() const override { return std::make_unique<MujocoEnvironment>(*this); }

    // As step(), in double precision: action [action_dim]; the new state is in `observation`.
    Step advance(std::span<const double> action) {
        to_control(action);
        if (task->rules == Rules::maze2d) clip_velocity();
        const double x_before = x_position();
        std::copy(control.begin(), control.end(), data->ctrl);
        for (int i = 0; i < task->frame_skip; ++i) mj_step(model.get(), data.get());
        // No mj_forward here: quantities derived from qpos and qvel are of the integrator's last evaluation, as in gym.
        ++steps;
        check_engine();
        observe();
        return {reward(x_before), terminated()};
    }

    // Of the step just made; x_before: x_position() before it.
    double reward(double x_before) const {
        if (task->maze) return distance_to_goal() <= goal_radius ? 1 : 0;  // D4RL's sparse reward
        double squares = 0;
        for (const double a : control) squares += a * a;
        const double forward = (x_position() - x_before) / step_time();  // mean velocity along x, m/s
        const double alive = task->rules == Rules::halfcheetah ? 0 : 1;  // per step, the last one too
        const double control_cost = task->control_cost * squares;        // of the clipped action
        // gym's ant also pays 0.0005 per squared contact force, cfrc_ext, which is always 0: mj_step computes it for
        // sensors alone, which the model does not have, and neither gym nor D4RL's collection computed it.
        return forward + alive - control_cost;
    }

    // Comparisons are written so that NaN terminates, as in gym.
    bool terminated() const {
        const double *qpos = data->qpos, *qvel = data->qvel;
        switch (task->rules) {
            case Rules::hopper: {  // gym's Hopper-v2; velocities are not clipped here
                bool bounded = all_finite();
                for (int i = 2; i < model->nq; ++i) bounded = bounded && std::fabs(qpos[i]) < 100;
                for (int i = 0; i < model->nv; ++i) bounded = bounded && std::fabs(qvel[i]) < 100;
                return !(bounded && qpos[1] > 0.7 && std::fabs(qpos[2]) < 0.2);
            }
            case Rules::walker2d:  // gym's Walker2d-v2: height, pitch
                return !(qpos[1] > 0.8 && qpos[1] < 2.0 && qpos[2] > -1.0 && qpos[2] < 1.0);
            case Rules::ant:  // gym's Ant-v2: height
                return !(all_finite() && qpos[2] >= 0.2 && qpos[2] <= 1.0);
            case Rules::antmaze:  // D4RL: success ends an episode, a fall does not
                return distance_to_goal() <= goal_radius;
            case Rules::halfcheetah:  // gym's HalfCheetah-v2: never
            case Rules::maze2d:       // D4RL: never
                return false;
        }
        return false;
    }

    // Writes `observation`, all that a policy sees: neither the goal nor the walls of a maze.
    void observe() {
        auto to = std::copy(data->qpos + task->first_position, data->qpos + model->nq, observation.begin());
        for (int i = 0; i < model->nv; ++i)
            *to++ = std::clamp(data->qvel[i], -task->velocity_limit, task->velocity_limit);
        for (int i = 0; to != observation.end(); ++i) *to++ = std::clamp(data->cfrc_ext[i], -1.0, 1.0);
    }

    double step_time() const { return model->opt.timestep * task->frame_skip; }  // seconds per action
    // gym's ant takes the torso's position in the world, which after a Runge-Kutta step is that of the last stage; the
    // other tasks take qpos.
    double x_position() const { return task->rules == Rules::ant ? data->xpos[3] : data->qpos[0]; }

    double distance_to_goal() const { return std::hypot(data->qpos[0] - goal[0], data->qpos[1] - goal[1]); }

    bool all_finite() const {
        const auto finite = [](double x) { return std::isfinite(x); };
        return std::all_of(data->qpos, data->qpos + model->nq, finite) &&
               std::all_of(data->qvel, data->qvel + model->nv, finite);
    }

    // Writes `control`: the action, in [-1, 1], in the actuators' range. D4RL's wrapper computes
    // low + (a + 1) (high - low) / 2, clipped; its maze2d has no wrapper and only clips. `action` may be `control`.
    void to_control(std::span<const double> action) {
        for (size_t i = 0; i < control.size(); ++i) {
            if (!std::isfinite(action[i]))
                fail("mujoco.bad_action", "%s: step %d: entry %zu of the action is %g; a finite number is needed",
                     task->name, steps + 1, i, action[i]);
            const double low = model->actuator_ctrlrange[2 * i], high = model->actuator_ctrlrange[2 * i + 1];
            const double scaled = task->rules == Rules::maze2d ? action[i] : low + (action[i] + 1) * 0.5 * (high - low);
            control[i] = std::clamp(scaled, low, high);
        }
    }

    // D4RL's maze2d clips velocities to [-5, 5] m/s before a step, by set_state under the previous control.
    void clip_velocity() {
        for (int i = 0; i < model->nv; ++i) data->qvel[i] = std::clamp(data->qvel[i], -5.0, 5.0);
        mj_forward(model.get(), data.get());
    }

    // mujoco-py made every warning of the engine an exception, and D4RL's collection dropped the episode. By itself the
    // engine resets the state and goes on. Errors: environment.unstable.
    void check_engine() const {
        // Not mju_warningText(), which writes to one static buffer: episodes take their steps at the same time.
        constexpr const char* texts[mjNWARNING] = {"the inertia matrix is nearly singular at DOF",
                                                   "too many contacts for a buffer of",
                                                   "too many constraints for a buffer of",
                                                   "too many visual geoms for a buffer of",
                                                   "bad number in qpos at DOF",
                                                   "bad number in qvel at DOF",
                                                   "bad number in qacc at DOF",
                                                   "bad number in control"};
        for (int i = 0; i < mjNWARNING; ++i)
            if (data->warning[i].number > 0)
                fail("environment.unstable", "%s: step %d: MuJoCo: %s %d", task->name, steps, texts[i],
                     data->warning[i].lastinfo);
        if (!all_finite())
            fail("environment.unstable", "%s: step %d: a position or velocity is not finite", task->name, steps);
    }

    // maze2d: the goal cell's indices. antmaze: the goal cell's centre.
    std::array<double, 2> default_goal() const {
        if (!task->maze) return {};
        const MazeCell cell = cells_marked(task->maze, 'G')[0];
        if (task->rules == Rules::maze2d) return {static_cast<double>(cell.row), static_cast<double>(cell.column)};
        return {4.0 * (cell.column - 1), 4.0 * (cell.row - 1)};
    }
};

#endif  // WODTEM_MUJOCO

// One episode of uniformly random actions, up to the time limit; nothing if the simulation broke down. `number`: of the
// trajectory within a data set.
inline std::optional<Trajectory> random_trajectory(Environment& environment, uint32_t seed, uint64_t number) {
    const Random resets{seed, Stream::environment}, actions{seed, Stream::data_set};
    const auto choose = [&](const Episode& episode) {
        std::vector<float> action(environment.spec().action_dim);
        for (uint32_t i = 0; i < action.size(); ++i)
            action[i] = static_cast<float>(2 * actions.uniform(number, episode.trajectory.length(), i) - 1);
        return action;
    };
    Episode episode = play(environment, resets, data_set_episodes + number, choose);
    if (!episode.error.empty()) return std::nullopt;
    return std::move(episode.trajectory);
}
