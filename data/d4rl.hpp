// d4rl.hpp: data sets in D4RL's and Minari's layouts: where they are found, their rows, and the trajectories in them.
//
// A D4RL file is one table of N steps in the order in which they were taken (HDF5 data sets, numbers of any type):
//   observations        N x S    the state s_t before the step      actions     N x A    a_t
//   rewards             N        r_t                                terminals   N        the task ended the episode
//   timeouts            N        the time limit ended the episode; missing in the first versions
//   next_observations   N x S    s_{t+1}; in the gym tasks alone    infos, metadata      not used
// d3rlpy 1 writes the same but for episode_terminals, N, in the place of timeouts: the last step of any episode.
// A Minari file has a group for each episode, of T steps:
//   episode_0/observations  T+1 x S | actions  T x A | rewards, terminations, truncations  T          episode_1/...
// and in the attribute total_episodes says how many there are. Where observations are dictionaries, as in its mazes,
// episode_0/observations is a group of tables, of which minari_states says which ones are the state.
// Promises: every quirk of the published files is handled on purpose and said here; a file of another shape, with NaN
// or of another task is refused with a sentence. Leaves out: how an HDF5 file is laid out (hdf5.hpp), writing.
#pragma once

#include "../mujoco_env.hpp"
#include "hdf5.hpp"  // and with it the standard headers
#include "rows.hpp"
#include "settings.hpp"

// ---------------------------------------------------------------------------------------------------------------------
// The published data sets. Files and checksums are those that TensorFlow Datasets records; statistics are from its
// catalogue and from comments in public decision transformers; ant's mean returns follow from its normalised ones,
// 80.30 and 30.95. NaN and 0: not published.

struct PublishedDataSet {
    const char* id;
    const char* file;      // below the address
    size_t steps = 0;      // rows; 0: not in the paper, and `wodtem collect` makes no stand-in
    int trajectories = 0;  // complete ones
    double mean_return = NAN, deviation = NAN, high = NAN, low = NAN;
    const char* collected_in = "";  // what `wodtem collect` takes on one core, as measured
    const char* sha256 = "";        // "": not published
};
constexpr const char* published_address = "http://rail.eecs.berkeley.edu/datasets/offline_rl/";
constexpr std::array<PublishedDataSet, 29> published_data_sets{{
    {"hopper-medium-v2", "gym_mujoco_v2/hopper_medium-v2.hdf5", 1000000, 2186, 1422.06, 378.95, 3222.36, 315.87,
     "1 minute", "5bdf1bc4a713c82941de44633df669b36c89850b652a25985166796d25cf71a0"},
    {"hopper-medium-replay-v2", "gym_mujoco_v2/hopper_medium_replay-v2.hdf5", 402000, 2041, 467.30, 511.03, 3192.93,
     -1.44, "85,000 updates of 5 ms", "e121c5f7c9857a307baa9edc6a2c3b48e85fedb9ac316ecddd0f48ca7ef4e39b"},
    {"walker2d-medium-v2", "gym_mujoco_v2/walker2d_medium-v2.hdf5", 1000000, 1190, 2852.09, 1095.44, 4226.94, -6.61,
     "2 minutes", "cf00f43add04c17fdfc2958dd581dea0851b2e5bedbe6fda073758a8f841aeda"},
    {"walker2d-medium-replay-v2", "gym_mujoco_v2/walker2d_medium_replay-v2.hdf5", 302000, 1093, 682.70, 895.96, 4132.00,
     -50.20, "250,000 updates of 5 ms", "e75de96a4f77acf7d4e0d6fdf0d7ccb177c26c44bb4388e4fd99f543ccfa18db"},
    {"halfcheetah-medium-v2", "gym_mujoco_v2/halfcheetah_medium-v2.hdf5", 1000000, 1000, 4770.33, 355.75, 5309.38,
     -310.23, "1 minute", "41324e8487a9556d8cfa4538827f8937f4d63dae3030825ebc9f3a726ed08ca0"},
    {"halfcheetah-medium-replay-v2", "gym_mujoco_v2/halfcheetah_medium_replay-v2.hdf5", 202000, 202, 3093.29, 1680.69,
     4985.14, -638.49, "125,000 updates of 5 ms", "48d494a4770c11f48260736dec090b78bdca8375647ed4d24bfa5b6610c7f683"},
    {"ant-medium-v2", "gym_mujoco_v2/ant_medium-v2.hdf5", 1000000, 1202, 3051.26, NAN, NAN, NAN, "4 minutes",
     "461c03b9f70f40d66b47608a92965e4ef3642bd9cdb1320d10acc92754167137"},
    {"ant-medium-replay-v2", "gym_mujoco_v2/ant_medium_replay-v2.hdf5", 302000, 485, 975.94, NAN, NAN, NAN,
     "390,000 updates of 7 ms", "844c4e5743ef51091f2106a3570b257fb149032c4743f8a5f02f40adc3b42a46"},
    {"antmaze-umaze-v2", "ant_maze_v2/Ant_maze_u-maze_noisy_multistart_False_multigoal_False_sparse_fixed.hdf5",
     1000000, 0, NAN, NAN, NAN, NAN, "6 minutes", "5ef15257771c50ef4d23c7de001750e96c8bb5d9b6a5e4a821dcfb3065fbd130"},
    {"antmaze-umaze-diverse-v2", "ant_maze_v2/Ant_maze_u-maze_noisy_multistart_True_multigoal_True_sparse_fixed.hdf5",
     1000000, 0, NAN, NAN, NAN, NAN, "6 minutes", "c771dd63963cd7d9f55f24a6d809064f6b82250a6aeac4c9d13f9a1d06e8c932"},
    {"maze2d-umaze-v1", "maze2d/maze2d-umaze-sparse-v1.hdf5", 1000000, 0, NAN, NAN, NAN, NAN, "3 seconds", ""},
    {"maze2d-medium-v1", "maze2d/maze2d-medium-sparse-v1.hdf5", 2000000, 0, NAN, NAN, NAN, NAN, "8 seconds", ""},
    {"maze2d-large-v1", "maze2d/maze2d-large-sparse-v1.hdf5", 4000000, 0, NAN, NAN, NAN, NAN, "18 seconds", ""},
    {"hopper-random-v2", "gym_mujoco_v2/hopper_random-v2.hdf5"},
    {"hopper-medium-expert-v2", "gym_mujoco_v2/hopper_medium_expert-v2.hdf5"},
    {"hopper-expert-v2", "gym_mujoco_v2/hopper_expert-v2.hdf5"},
    {"hopper-full-replay-v2", "gym_mujoco_v2/hopper_full_replay-v2.hdf5"},
    {"walker2d-random-v2", "gym_mujoco_v2/walker2d_random-v2.hdf5"},
    {"walker2d-medium-expert-v2", "gym_mujoco_v2/walker2d_medium_expert-v2.hdf5"},
    {"walker2d-expert-v2", "gym_mujoco_v2/walker2d_expert-v2.hdf5"},
    {"walker2d-full-replay-v2", "gym_mujoco_v2/walker2d_full_replay-v2.hdf5"},
    {"halfcheetah-random-v2", "gym_mujoco_v2/halfcheetah_random-v2.hdf5"},
    {"halfcheetah-medium-expert-v2", "gym_mujoco_v2/halfcheetah_medium_expert-v2.hdf5"},
    {"halfcheetah-expert-v2", "gym_mujoco_v2/halfcheetah_expert-v2.hdf5"},
    {"halfcheetah-full-replay-v2", "gym_mujoco_v2/halfcheetah_full_replay-v2.hdf5"},
    {"ant-random-v2", "gym_mujoco_v2/ant_random-v2.hdf5"},
    {"ant-medium-expert-v2", "gym_mujoco_v2/ant_medium_expert-v2.hdf5"},
    {"ant-expert-v2", "gym_mujoco_v2/ant_expert-v2.hdf5"},
    {"ant-full-replay-v2", "gym_mujoco_v2/ant_full_replay-v2.hdf5"},
}};

inline const PublishedDataSet* find_published(std::string_view id) {
    const auto found = std::ranges::find(published_data_sets, id, &PublishedDataSet::id);
    return found == published_data_sets.end() ? nullptr : &*found;
}

// Returns the mean return of a gym task's medium set.
inline double medium_return(const MujocoTask& task) {
    return find_published(std::string(task.name) + "-medium-v2")->mean_return;
}

// Returns the file's name without folders, as D4RL saves it.
inline std::string file_name(const PublishedDataSet& set) { return std::filesystem::path(set.file).filename(); }

constexpr const char* own_folder = "runs/datasets";

// Returns the file of a data set: `given` itself, or that of the numbers in a folder of Minari's.
// Errors: dataset.arrow for Minari's other form, dataset.folder for any other folder.
inline std::string data_set_file(const std::string& given) {
    for (const char* file : {"/data/main_data.hdf5", "/main_data.hdf5"})
        if (is_there(given + file)) return given + file;
    for (const char* file : {"/data/0/part-0.arrow", "/0/part-0.arrow", "/part-0.arrow", ""})
        require(!(given + file).ends_with(".arrow") || !is_there(given + file), "dataset.arrow", given,
                ": is Minari's Arrow form, which is not read here; write it with data_format='hdf5'");
    std::error_code none;
    require(!std::filesystem::is_directory(given, none), "dataset.folder", given,
            ": is a folder without Minari's data/main_data.hdf5; give the folder of one data set, or a file");
    return given;
}

// Returns what a data set is called: its file's name, or for Minari's FIRST/SECOND/data/main_data.hdf5, whose file has
// the same name in every folder, FIRST-SECOND.hdf5.
inline std::string data_set_name(const std::string& path) {
    const std::filesystem::path file = std::filesystem::absolute(path).lexically_normal();
    std::filesystem::path folder = file.parent_path();
    if (folder.filename() == "data") folder = folder.parent_path();
    const std::string first = folder.parent_path().filename(), second = folder.filename();
    return file.filename() != "main_data.hdf5" || first.empty() ? file.filename().string()
                                                                : first + "-" + second + ".hdf5";
}

// Returns D4RL's cache: the folder that its environment variable names, else one in the home folder.
inline std::string d4rl_folder() {
    if (const char* folder = std::getenv("D4RL_DATASET_DIR"); folder && *folder) return folder;
    const char* home = std::getenv("HOME");
    return std::string(home ? home : ".") + "/.d4rl/datasets";
}

// Returns the path of a data set's file: in D4RL's folder, else in own_folder. Errors: dataset.missing.
inline std::string find_data_set(const PublishedDataSet& set) {
    const std::string name = file_name(set);
    std::string looked;
    for (const std::string& folder : {d4rl_folder(), std::string(own_folder)}) {
        const std::string path = folder + "/" + name;
        if (std::filesystem::exists(path)) return path;
        looked += (looked.empty() ? "" : " and ") + path;
    }
    const std::string stand_in =
        set.steps == 0 ? "" : text_of("a stand-in is made by: wodtem collect ", set.id, " (", set.collected_in, "); ");
    fail("dataset.missing",
         "the data set of %s is not here: looked for %s. The original is published at %s%s; %sor give a file with "
         "--dataset",
         set.id, looked.c_str(), published_address, set.file, stand_in.c_str());
}

// ---------------------------------------------------------------------------------------------------------------------
// The rows of a file

struct Rows {
    size_t count = 0, state_dim = 0, action_dim = 0;
    std::vector<float> observations, next_observations;  // [count, state_dim]; the second may be empty
    std::vector<float> actions, rewards;                 // [count, action_dim], [count]
    std::vector<uint8_t> terminals, timeouts;            // [count]; timeouts may be empty
    bool integer_actions = false;                        // by their type in the file
    bool of_minari = false;                              // the file's layout
    std::string read_as = "";                            // what was chosen in reading it; "": nothing was to choose

    const float* observation(size_t row) const { return &observations[row * state_dim]; }
    bool ends(size_t row) const { return terminals[row] != 0 || (!timeouts.empty() && timeouts[row] != 0); }
};

struct Hdf5Table {
    const Hdf5Dataset& data;
    uint64_t rows, columns;
};

// Returns a data set of two dimensions, or of one, which is a single column. Errors: dataset.shape if it is missing or
// its rows or columns are not those expected.
inline Hdf5Table table_of(const Hdf5File& file, const std::string& name, std::optional<uint64_t> rows = {},
                          std::optional<uint64_t> columns = {}) {
    const Hdf5Dataset* found = file.find(name);
    const auto below = [&](const Hdf5Dataset& other) { return other.path.starts_with(name + "/"); };
    const bool is_group = !found && std::ranges::any_of(file.datasets, below);
    require(!is_group, "dataset.shape", file.path, ": \"", name,
            "\" is a group; write one table of numbers instead, or name a maze's task");
    require(found, "dataset.shape", file.path, ": has no data set \"", name, "\"; ",
            name.starts_with("episode_") ? "in Minari's layout each episode has it"
                                         : "it is in neither D4RL's layout nor Minari's (episode_0/observations)");
    require(found->unsupported.empty(), "hdf5.unsupported", dataset_place(file.path, name),
            "cannot be read: ", found->unsupported);
    const Shape& shape = found->shape;
    const uint64_t width = shape.size() == 2 ? shape[1] : 1;
    const auto text = [](std::optional<uint64_t> n) { return n ? std::to_string(*n) : "any number"; };
    const bool table = shape.size() == 1 || shape.size() == 2;
    const bool fits = table && shape[0] == rows.value_or(shape[0]) && width == columns.value_or(width);
    require(fits, "dataset.shape", file.path, ": \"", name, "\" has shape ", shape_text(shape), ", expected ",
            text(rows), " by ", text(columns));
    return {*found, shape[0], width};
}

// Returns a data set of so many rows and one column. Errors: dataset.shape.
inline const Hdf5Dataset& column_of(const Hdf5File& file, const std::string& name, uint64_t rows) {
    return table_of(file, name, rows, 1).data;
}

inline bool is_integer(const Hdf5Dataset& data) {
    return data.element.kind == Hdf5Element::signed_integer || data.element.kind == Hdf5Element::unsigned_integer;
}

// Refuses a column of D4RL's table, or of the `group` of Minari's episode, that is not `known`: it may mark the ends of
// episodes. ends: what marks them. Errors: dataset.column.
inline void require_known_column(const Hdf5File& file, const std::string& name, const std::string& group, uint64_t rows,
                                 const std::set<std::string>& known, const std::string& ends) {
    const std::string column_name = name.substr(group.size());
    if (column_name.find('/') != std::string::npos || known.contains(column_name) || column_name == ends) return;
    const Hdf5Dataset* column = file.find(name);
    require(!column || column->shape.empty() || column->shape[0] != rows, "dataset.column",
            dataset_place(file.path, name), "has a row for each step and is not read beside ", ends,
            "; name what marks the ends of episodes ", ends, ", and move the rest to a group such as infos");
}

// Reads D4RL's layout. Errors: dataset.shape, dataset.column, those of hdf5.hpp.
inline Rows read_rows(const Hdf5File& file) {
    const Hdf5Table states = table_of(file, "observations"), actions = table_of(file, "actions", states.rows);
    Rows rows;
    rows.count = states.rows;
    rows.state_dim = states.columns;
    rows.action_dim = actions.columns;
    const bool empty = rows.count == 0 || rows.state_dim == 0 || rows.action_dim == 0;
    require(!empty, "dataset.shape", file.path, ": holds no steps");
    rows.observations = file.read<float>(states.data);
    rows.actions = file.read<float>(actions.data);
    rows.integer_actions = is_integer(actions.data);
    rows.rewards = file.read<float>(column_of(file, "rewards", rows.count));
    rows.terminals = file.read_flags(column_of(file, "terminals", rows.count));
    const bool of_d3rlpy = file.find("episode_terminals") && !file.find("timeouts");
    const std::string ends = of_d3rlpy ? "episode_terminals" : "timeouts";
    for (const std::string& name : file.names())
        require_known_column(file, name, "", rows.count,
                             {"observations", "actions", "rewards", "terminals", "next_observations"}, ends);
    if (file.find(ends)) rows.timeouts = file.read_flags(column_of(file, ends, rows.count));
    if (of_d3rlpy)  // also set where the task ended the episode, which is no timeout
        for (size_t row = 0; row < rows.count; ++row) rows.timeouts[row] &= rows.terminals[row] == 0;
    if (file.find("next_observations"))
        rows.next_observations = file.read<float>(table_of(file, "next_observations", rows.count, rows.state_dim).data);
    return rows;
}

// The number of the episode in whose group, "episode_12", a name of Minari's layout lies; nothing for other names.
inline std::optional<uint64_t> minari_episode(const std::string& name) {
    const std::string group = name.substr(0, name.find('/'));
    uint64_t number = 0;
    if (group.starts_with("episode_")) std::from_chars(group.data() + 8, group.data() + group.size(), number);
    return group == "episode_" + std::to_string(number) ? std::optional(number) : std::nullopt;
}

inline bool is_minari(const Hdf5File& file) {
    return std::ranges::any_of(file.names(), [](const std::string& name) { return minari_episode(name).has_value(); });
}

// Errors: dataset.episodes if an attribute states another number of episodes or steps than there are.
inline void require_stated(const Hdf5File& file, const char* attribute, size_t count) {
    const auto stated = file.attributes.find(attribute);
    if (stated == file.attributes.end()) return;
    require(stated->second == static_cast<double>(count), "dataset.episodes", file.path, ": its attribute ", attribute,
            " says ", stated->second, ", but it holds ", count, "; is a part missing?");
}

// The numbers of Minari's episodes, ascending; some may be missing between them. Errors: dataset.episodes if the file
// counts them otherwise, dataset.column for what belongs to no episode.
inline std::set<uint64_t> minari_episodes(const Hdf5File& file) {
    std::set<uint64_t> episodes;
    for (const std::string& name : file.names()) {
        const std::optional<uint64_t> episode = minari_episode(name);
        require(episode.has_value(), "dataset.column", dataset_place(file.path, name),
                "lies in none of Minari's groups episode_0, episode_1, ...");
        episodes.insert(*episode);
        const std::string group = "episode_" + std::to_string(*episode) + "/";
        const Hdf5Dataset* actions = file.find(group + "actions");
        if (actions && !actions->shape.empty() && name.starts_with(group))
            require_known_column(file, name, group, actions->shape[0],
                                 {"observations", "actions", "rewards", "terminations"}, "truncations");
    }
    require_stated(file, "total_episodes", episodes.size());
    return episodes;
}

// Of the dictionary observations of Minari's mazes (of Gymnasium-Robotics): the parts that make up a task's state.
struct MinariState {
    Rules rules;
    std::vector<std::string> parts;  // below "observations"
    const char* meaning;             // what was chosen, and how the two worlds differ
};
inline const MinariState minari_states[] = {
    {Rules::antmaze,
     {"/achieved_goal", "/observation"},
     "the state is achieved_goal and observation; AntMaze counts positions from the middle of the map and y upwards, "
     "antmaze from its start cell and y downwards; its ant pushes with up to 150 N m for 0.05 s, antmaze's with 30 N m "
     "for 0.1 s; its goal has a radius of 0.45, not 0.5"},
    {Rules::maze2d,
     {"/observation"},
     "the state is observation; PointMaze's positions, velocities and actions are turned and moved into maze2d's "
     "coordinates; what remains: a touch of a wall ends 0.03 to 0.07 elsewhere, its goal has a radius of 0.45, not "
     "0.5, and each episode has its own, to which the rewards belong"}};

// Returns the parts of the dictionary observations in the group `name` that are the task's state; null where it is no
// group, or the task has none.
inline const MinariState* minari_state(const Hdf5File& file, const std::string& name, const MujocoTask* task) {
    const auto of_task = [&](const MinariState& state) { return task && state.rules == task->rules; };
    const auto found = std::ranges::find_if(minari_states, of_task);
    return found != std::end(minari_states) && file.groups.contains(name) ? found : nullptr;
}

// Returns tables of so many rows side by side, row-major; each name is `group` and a part. Errors: those of table_of().
inline std::vector<double> read_side_by_side(const Hdf5File& file, const std::string& group,
                                             const std::vector<std::string>& parts, uint64_t rows) {
    std::vector<std::vector<double>> tables;
    for (const std::string& part : parts) tables.push_back(file.read<double>(table_of(file, group + part, rows).data));
    std::vector<double> all;
    for (uint64_t row = 0; row < rows; ++row)
        for (const std::vector<double>& table : tables) {
            const size_t width = table.size() / rows;
            all.insert(all.end(), table.begin() + row * width, table.begin() + (row + 1) * width);
        }
    return all;
}

// Turns numbers of Minari's PointMaze-v3 into those of maze2d, whose map is the same: PointMaze's X and Y run along
// columns and up the rows from the middle of the map, maze2d's x and y down rows and along columns (maze_place()).
//   states, rows (X, Y, VX, VY):   (rows / 2 - 0.7 - Y, columns / 2 - 0.7 + X, -VY, VX)     actions (A, B):   (-B, A)
inline void turn_to_maze2d(std::vector<double>& states, std::vector<float>& actions, const MujocoTask& task) {
    const MazeGrid grid{task.maze};
    const double top = grid.rows / 2.0 - 0.7, left = grid.columns / 2.0 - 0.7;
    for (size_t i = 0; i + 4 <= states.size(); i += 4) {
        const std::array<double, 4> s = {states[i], states[i + 1], states[i + 2], states[i + 3]};
        std::ranges::copy(std::array{top - s[1], left + s[0], -s[3], s[2]}, &states[i]);
    }
    for (size_t i = 0; i + 2 <= actions.size(); i += 2) {
        std::swap(actions[i], actions[i + 1]);
        actions[i] = -actions[i];
    }
}

// Reads Minari's episodes, one after the other. The observation after the last action becomes the last row's next one.
// task: whose state dictionary observations are to give; null: they are refused. Errors: dataset.shape, those of
// minari_episodes() and hdf5.hpp.
inline Rows read_minari(const Hdf5File& file, const MujocoTask* task = nullptr) {
    Rows rows;
    rows.of_minari = true;
    for (const uint64_t episode : minari_episodes(file)) {
        const std::string group = "episode_" + std::to_string(episode) + "/";
        const Hdf5Table actions = table_of(file, group + "actions");
        const uint64_t steps = actions.rows;
        const MinariState* dictionary = minari_state(file, group + "observations", task);
        const std::vector<std::string> parts = dictionary ? dictionary->parts : std::vector<std::string>{""};
        std::vector<double> states = read_side_by_side(file, group + "observations", parts, steps + 1);
        const size_t columns = states.size() / (steps + 1);
        if (rows.count == 0) {
            rows.state_dim = columns;
            rows.action_dim = actions.columns;
            rows.integer_actions = is_integer(actions.data);
        }
        const bool empty = steps == 0 || columns == 0 || actions.columns == 0;
        const bool alike = columns == rows.state_dim && actions.columns == rows.action_dim;
        require(alike && !empty, "dataset.shape", file.path, ": ", group, "observations and actions have ", columns,
                " and ", actions.columns, " columns, ", steps, " steps; the first has ", rows.state_dim, " and ",
                rows.action_dim, " columns");
        std::vector<float> taken = file.read<float>(actions.data);
        if (dictionary && task->rules == Rules::maze2d) turn_to_maze2d(states, taken, *task);
        if (dictionary) rows.read_as = dictionary->meaning;
        const std::vector<float> all(states.begin(), states.end());  // rounded to the nearest
        append_all(rows.observations, std::span(all).first(steps * rows.state_dim));
        append_all(rows.next_observations, std::span(all).last(steps * rows.state_dim));
        append_all(rows.actions, taken);
        append_all(rows.rewards, file.read<float>(column_of(file, group + "rewards", steps)));
        append_all(rows.terminals, file.read_flags(column_of(file, group + "terminations", steps)));
        append_all(rows.timeouts, file.read_flags(column_of(file, group + "truncations", steps)));
        if (rows.terminals.back() == 0) rows.timeouts.back() = 1;  // an episode ends where its group does
        rows.count += steps;
    }
    require_stated(file, "total_steps", rows.count);
    return rows;
}

// task: as for read_minari().
inline Rows read_data_set(const Hdf5File& file, const MujocoTask* task = nullptr) {
    return is_minari(file) ? read_minari(file, task) : read_rows(file);
}

// True for a file with an HDF5 name, so that a damaged one is refused as such, or with an HDF5 superblock.
// Errors: those of has_superblock().
inline bool is_hdf5(const std::string& path) {
    const std::filesystem::path extension = std::filesystem::path(path).extension();
    return extension == ".hdf5" || extension == ".h5" || has_superblock(path);
}

// ---------------------------------------------------------------------------------------------------------------------
// From rows to trajectories

// Returns the given rows as a trajectory, in vectors without room to spare: a data set is large.
inline Trajectory trajectory_of(const Rows& rows, std::span<const size_t> which) {
    const auto gather = [&](std::vector<float>& to, const std::vector<float>& from, size_t width) {
        to.reserve(which.size() * width);
        for (const size_t row : which) to.insert(to.end(), &from[row * width], &from[row * width] + width);
    };
    Trajectory trajectory;
    gather(trajectory.states, rows.observations, rows.state_dim);
    gather(trajectory.actions, rows.actions, rows.action_dim);
    gather(trajectory.rewards, rows.rewards, 1);
    trajectory.terminated = rows.terminals[which.back()] != 0;
    return trajectory;
}

// Returns the trajectories that the rows `which` make, one after the other: each ends with a row which[i] for which
// ends(i) holds. Rows after the last end make none.
inline std::vector<Trajectory> cut(const Rows& rows, const std::vector<size_t>& which, const auto& ends) {
    std::vector<Trajectory> trajectories;
    for (size_t begin = 0, i = 0; i < which.size(); ++i) {
        if (!ends(i)) continue;
        trajectories.push_back(trajectory_of(rows, std::span(which).subspan(begin, i + 1 - begin)));
        begin = i + 1;
    }
    return trajectories;
}

// Returns the timeouts; of a file without them (the first versions) a flag for every `limit`-th step of an episode.
inline std::vector<uint8_t> timeouts_of(const Rows& rows, size_t limit) {
    if (!rows.timeouts.empty()) return rows.timeouts;
    std::vector<uint8_t> timeouts(rows.count);
    size_t steps = 0;  // of the episode
    for (size_t row = 0; row < rows.count; ++row) {
        timeouts[row] = ++steps == limit;
        if (timeouts[row] != 0 || rows.terminals[row] != 0) steps = 0;
    }
    return timeouts;
}

// D4RL and ODT's code: a trajectory ends with a row whose terminals or timeouts is set. A step that is both the last
// one allowed and a fall carries only the timeout. Rows after the last flag are no trajectory: the collection stopped.
//   Gym sets of replay buffers: timeouts also mark the ends of collection blocks; they cut, as in D4RL.
//   maze2d: terminals are all 0, and timeouts mark that a navigation goal was reached; the body is not reset, and the
//   next row starts where this one ended. So the highest returns belong to trajectories that leave the rewarded goal.
inline std::vector<Trajectory> cut_at_flags(const Rows& rows, size_t limit) {
    const std::vector<uint8_t> timeouts = timeouts_of(rows, limit);
    std::vector<size_t> all(rows.count);
    std::iota(all.begin(), all.end(), size_t{0});
    return cut(rows, all, [&](size_t row) { return rows.terminals[row] != 0 || timeouts[row] != 0; });
}

// ODT's code for antmaze: it makes D4RL's Q-learning tuples (s_t, a_t, r_t, s_{t+1} = the next row), leaving out rows
// with a timeout and the very last row. A trajectory ends at a terminal, where the next tuple does not start from
// s_{t+1}, and with the last tuple. In umaze-v2 episodes go on after success, with a terminal in every row at the goal:
// each becomes a trajectory of one step and return 1, as in ODT.
inline std::vector<Trajectory> cut_tuples(const Rows& rows, size_t limit) {
    const std::vector<uint8_t> timeouts = timeouts_of(rows, limit);
    std::vector<size_t> tuples;
    for (size_t row = 0; row + 1 < rows.count; ++row)
        if (timeouts[row] == 0) tuples.push_back(row);
    const auto continues = [&](size_t row, size_t next) {
        double squared = 0;
        for (size_t i = 0; i < rows.state_dim; ++i) {
            const double difference = static_cast<double>(rows.observation(next)[i]) - rows.observation(row + 1)[i];
            squared += difference * difference;
        }
        return squared <= 1e-12;  // 1e-6 in norm
    };
    return cut(rows, tuples, [&](size_t i) {
        return rows.terminals[tuples[i]] != 0 || i + 1 == tuples.size() || !continues(tuples[i], tuples[i + 1]);
    });
}

// Returns a data set's trajectories by the rules of the task's family. Errors: dataset.task if the rows are not of this
// task's size, dataset.empty.
inline std::vector<Trajectory> cut_trajectories(const Rows& rows, const MujocoTask& task, const std::string& path) {
    const size_t state_dim = task.state_dim, action_dim = task.action_dim;
    require(rows.state_dim == state_dim && rows.action_dim == action_dim, "dataset.task", path, ": has ",
            rows.state_dim, " state and ", rows.action_dim, " action numbers a step; ", task.name, " has ", state_dim,
            " and ", action_dim, ": is it of another task?");
    const size_t limit = static_cast<size_t>(task.max_episode_steps);
    std::vector<Trajectory> trajectories =
        task.rules == Rules::antmaze ? cut_tuples(rows, limit) : cut_at_flags(rows, limit);
    require(!trajectories.empty(), "dataset.empty", path,
            ": no step is marked as the end of a trajectory, so there is none");
    return trajectories;
}

// Requires what a learner needs: finite numbers, and actions in [-1, 1], which published ones may leave by a rounding
// error. Errors: dataset.not_finite, dataset.action with the row and the column.
inline void require_sound(const Rows& rows, const std::string& path, float largest_action = 1 + 1e-5f) {
    const auto require_all = [&](const char* name, const std::vector<float>& values, size_t width, float bound) {
        for (size_t i = 0; i < values.size(); ++i) {
            if (std::fabs(values[i]) <= bound) continue;  // never so for NaN
            const bool finite = std::isfinite(values[i]);
            const std::string found = text_of("\", row ", i / width, ", column ", i % width, " is ", values[i]);
            require(!finite, "dataset.action", path, ": \"", name, found,
                    "; actions lie in [-1, 1]: is it of another task, or not scaled? Where they are commands that a "
                    "machine cut off, --clip-actions does the same");
            require(finite, "dataset.not_finite", path, ": \"", name, found,
                    "; only finite numbers can be learned from");
        }
    };
    constexpr float any = std::numeric_limits<float>::max();
    require_all("observations", rows.observations, rows.state_dim, any);
    require_all("actions", rows.actions, rows.action_dim, largest_action);
    require_all("rewards", rows.rewards, 1, any);
}

// Returns the rows whose position lies in no free cell of maze2d's map; of other tasks none.
inline std::vector<size_t> rows_outside(const Rows& rows, const MujocoTask& task) {
    std::vector<size_t> outside;
    if (task.rules != Rules::maze2d) return outside;
    const MazeGrid grid{task.maze};
    for (size_t row = 0; row < rows.count; ++row) {
        const float* const state = rows.observation(row);
        const MazePlace place = maze_place(task, state[0], state[1]);
        const double i = std::round(place.row), j = std::round(place.column);
        if (!grid.contains(i, j) || !grid.can_enter({static_cast<int>(i), static_cast<int>(j)})) outside.push_back(row);
    }
    return outside;
}

// A recorded step that was taken again, and the largest difference between the observation that followed and the
// recorded one. It is far off from 1e-3 on: of this program's own data sets of all robots and mazes it is below 4e-5.
struct Transition {
    double difference;
    size_t row;
    auto operator<=>(const Transition&) const = default;
};
constexpr double far_off = 1e-3;

// Takes up to 200 recorded steps, spread over the rows, again under these physics. Returns them with ascending
// differences; {} without MuJoCo. Left out: contact forces, and rows whose next one is not known, whose velocities are
// clipped, or that the engine breaks down on. What is not observed, x and for ant y, is taken for 0, which changes
// nothing.
inline std::vector<Transition> transition_differences([[maybe_unused]] const Rows& rows,
                                                      [[maybe_unused]] const MujocoTask& task,
                                                      [[maybe_unused]] Physics physics) {
    std::vector<Transition> differences;
#ifdef WODTEM_MUJOCO
    MujocoEnvironment environment(task, physics);
    const auto hidden = task.first_position, positions = environment.model->nq - hidden;  // numbers of qpos
    const auto observed = positions + environment.model->nv;
    const size_t count = std::min<size_t>(rows.count, 200);
    for (size_t k = 0; k < count; ++k) {
        const size_t row = k * rows.count / count;
        const float *state = rows.observation(row), *next = nullptr;
        if (!rows.next_observations.empty()) next = &rows.next_observations[row * rows.state_dim];
        if (!next && row + 1 < rows.count && !rows.ends(row)) next = rows.observation(row + 1);
        const auto clipped = [&](float v) { return std::fabs(v) >= task.velocity_limit; };
        if (!next || std::any_of(state + positions, state + observed, clipped)) continue;
        std::vector<double> qpos(environment.model->nq);
        std::copy(state, state + positions, qpos.begin() + hidden);
        environment.start(qpos, std::vector<double>(state + positions, state + observed));
        const float* const action = &rows.actions[row * rows.action_dim];
        try {
            environment.advance(std::vector<double>(action, action + rows.action_dim));
        } catch (const Error&) {
            continue;
        }
        double largest = 0;
        for (int i = 0; i < observed; ++i) largest = std::max(largest, std::fabs(environment.observation[i] - next[i]));
        differences.push_back({largest, row});
    }
    std::ranges::sort(differences);
#endif
    return differences;
}

using TransitionsOfPhysics = std::array<std::vector<Transition>, std::size(physics_names)>;

inline TransitionsOfPhysics transitions_of_each_physics(const Rows& rows, const MujocoTask& task) {
    return {transition_differences(rows, task, Physics::d4rl), transition_differences(rows, task, Physics::mujoco_2_2)};
}

inline double median_of(const std::vector<Transition>& transitions) {
    return transitions.empty() ? NAN : transitions[transitions.size() / 2].difference;
}

// The first row whose step ends far_off or further from the recorded state; nothing if none does.
inline std::optional<size_t> first_far_off(const std::vector<Transition>& transitions) {
    std::optional<size_t> first;
    for (const Transition& one : transitions)
        if (one.difference >= far_off && one.row < first.value_or(SIZE_MAX)) first = one.row;
    return first;
}

// Returns what the recorded steps, or else the file's layout, tell of the bodies that made them; "" if it is those of
// the chosen physics, or nobody knows. Other bodies are named if the median of their transition_differences() is less
// than a tenth of the chosen ones'; else neither made the data if both are far off.
inline std::string remark_on_bodies(const Rows& rows, const MujocoTask& task, const std::string& physics,
                                    const TransitionsOfPhysics& transitions) {
    const bool old = physics == "d4rl";
    const double chosen = median_of(transitions[!old]), other = median_of(transitions[old]);
    const char* const name = old ? "2.2" : "d4rl";
    if (10 * other < chosen)
        return text_of("other bodies made these data: recorded steps taken again end ", chosen,
                       " from the recorded state under physics ", physics, ", ", other, " under ", name,
                       "; choose these with --physics ", name);
    if (std::min(chosen, other) >= far_off)
        return text_of("neither physics made these data: recorded steps taken again end ", chosen,
                       " from the recorded state under physics ", physics, ", ", other, " under ", name,
                       " (medians), first in row ", *first_far_off(transitions[!old]), "; are they of ", task.name,
                       ", and in the units of its states?");
    if (rows.of_minari && old && !task.maze && !(10 * chosen < other))
        return "it is of Minari's layout: if Gymnasium made the data, its bodies are those of --physics 2.2; those of "
               "physics d4rl, which train takes unless told otherwise, weigh up to 7.7% less and move otherwise";
    return "";
}

// A sentence about rows_outside(), for users; "" if there are none.
inline std::string remark_on_places(const Rows& rows, const MujocoTask& task, const std::vector<size_t>& outside) {
    if (outside.empty()) return "";
    return text_of(outside.size(), " of ", rows.count, " positions lie in no free cell of ", task.name,
                   ", first in row ", outside[0], ": is it of another maze, or PointMaze's in coordinates of its own? ",
                   "Minari's own file of it is read in the right ones");
}

// Returns what else a user should know of a data set before training on it under these physics, a sentence each.
inline std::vector<std::string> remarks_on(const Rows& rows, const MujocoTask& task, const std::string& physics,
                                           const TransitionsOfPhysics& transitions) {
    std::vector<std::string> remarks;
    if (!rows.read_as.empty()) remarks.push_back(rows.read_as);
    const std::string bodies = remark_on_bodies(rows, task, physics, transitions);
    if (!bodies.empty()) remarks.push_back(bodies);
    const size_t with_contacts = 111, before_contacts = 27;  // ant's numbers
    bool alive = false;
    if (task.rules == Rules::ant && rows.state_dim == with_contacts)
        for (size_t i = 0; i < rows.observations.size(); ++i)
            alive = alive || (i % with_contacts >= before_contacts && rows.observations[i] != 0);
    if (alive)
        remarks.push_back(
            "ant's contact forces (columns 27 to 110) are not 0, as they are in D4RL's data and in this "
            "program: a policy would learn from numbers that it will never see");
    return remarks;
}

// The number of rows in no trajectory: of those that flags have cut, the rows after the last flag.
inline size_t rows_in_none(const Rows& rows, const std::vector<Trajectory>& trajectories) {
    size_t left = rows.count;
    for (const Trajectory& trajectory : trajectories) left -= trajectory.rewards.size();
    return left;
}

// Returns a sentence on the first column of observations, or the rewards, whose numbers are nearly one number beside a
// few far off: 98% of some 10,000 of them lie within a hundredth of their deviation. "": there is none, or few rows.
inline std::string remark_on_outliers(const Rows& rows) {
    const size_t width = rows.state_dim, stride = rows.count / 10000 + 1;
    const auto value = [&](size_t row, size_t column) {
        return column < width ? rows.observation(row)[column] : rows.rewards[row];
    };
    const double n = static_cast<double>(rows.count);
    std::vector<double> sums(width + 1), squares(width + 1), sample;
    for (size_t row = 0; row < rows.count; ++row)
        for (size_t column = 0; column <= width; ++column) sums[column] += value(row, column);
    for (size_t row = 0; row < rows.count; ++row)
        for (size_t column = 0; column <= width; ++column)
            squares[column] += std::pow(value(row, column) - sums[column] / n, 2);
    for (size_t column = 0; column <= width && rows.count >= 200; ++column) {
        sample.clear();
        for (size_t row = 0; row < rows.count; row += stride)
            if (const double x = value(row, column); std::isfinite(x)) sample.push_back(x);
        if (sample.empty()) continue;
        std::ranges::sort(sample);
        const double low = sample[sample.size() / 100], high = sample[sample.size() - 1 - sample.size() / 100];
        if (!(low < high && high - low < 0.01 * std::sqrt(squares[column] / n))) continue;
        size_t far = 0;
        for (size_t row = 1; row < rows.count; ++row)
            if (std::fabs(value(row, column) - low) > std::fabs(value(far, column) - low)) far = row;
        return text_of(column < width ? "\"observations\", row " : "\"rewards\", row ", far,
                       column < width ? text_of(", column ", column) : "", " is ", value(far, column),
                       ", so far from most others that these are nearly one number beside it: is it an error?");
    }
    return "";
}

// Says which rows are dropped or drown all others, if some are. cut_by_flags: rows after the last flag are in none.
inline void print_remarks(const Rows& rows, const std::vector<Trajectory>& trajectories, const std::string& path,
                          bool cut_by_flags) {
    if (const size_t left = rows_in_none(rows, trajectories); left > 0 && cut_by_flags)
        std::fprintf(stderr, "%s: of the rows, those after the last end of a trajectory are not used: %zu of %zu\n",
                     path.c_str(), left, rows.count);
    if (const std::string remark = remark_on_outliers(rows); !remark.empty())
        std::fprintf(stderr, "%s: %s\n", path.c_str(), remark.c_str());
}

// Clips the finite actions to [-1, 1] and says how many it changed.
inline void clip_actions(Rows& rows, const std::string& path) {
    size_t changed = 0;
    for (float& action : rows.actions) {
        if (std::fabs(action) <= 1 || !std::isfinite(action)) continue;
        action = std::copysign(1.0f, action);
        ++changed;
    }
    std::fprintf(stderr, "%s: %zu of %zu numbers of actions lay beyond 1 and were clipped\n", path.c_str(), changed,
                 rows.actions.size());
}

// The file's trajectories for a task, without returns; what is to be remarked goes to stderr. Of the settings it heeds
// cut (flags: where the file says so; else at the time limit, as in a file without timeouts, and at terminals),
// clip_actions and physics. Errors: dataset.*, hdf5.*, file.*; dataset.place if more than one position in a hundred is
// outside the maze.
inline std::vector<Trajectory> load_data_set(const std::string& path, const MujocoTask& task,
                                             const Settings& settings = {}) {
    Rows rows = read_data_set(open_hdf5(path), &task);
    if (settings.cut != "flags") rows.timeouts.clear();
    if (settings.clip_actions) clip_actions(rows, path);
    std::vector<Trajectory> trajectories = cut_trajectories(rows, task, path);
    require_sound(rows, path);
    const std::vector<size_t> outside = rows_outside(rows, task);
    const std::string places = remark_on_places(rows, task, outside);
    if (outside.size() * 100 > rows.count) throw Error("dataset.place", path + ": " + places);
    std::vector<std::string> remarks =
        remarks_on(rows, task, settings.physics, transitions_of_each_physics(rows, task));
    if (!places.empty()) remarks.push_back(places);
    for (const std::string& remark : remarks) std::fprintf(stderr, "%s: %s\n", path.c_str(), remark.c_str());
    print_remarks(rows, trajectories, path, task.rules != Rules::antmaze);
    return trajectories;
}

// Data of no task of this program: states and actions of any sizes.
struct OwnData {
    EnvironmentSpec spec;                  // its time limit is not used
    std::vector<Trajectory> trajectories;  // in the order of the file, without returns
};

// How many moves there are to choose from: one more than the greatest action, where actions are one whole number each
// and either of an integer type or above 1, which a continuous action cannot be; else 0. Errors: dataset.action, also
// for several whole numbers above 1, which are choices and no commands that could be clipped.
inline int number_of_moves(const Rows& rows, const std::string& path) {
    const auto whole = [](float x) { return x == std::floor(x); };
    if (!std::ranges::all_of(rows.actions, whole)) return 0;
    const auto [least, most] = std::ranges::minmax(rows.actions);
    require(rows.action_dim == 1 || most <= 1, "dataset.action", path, ": \"actions\" are ", rows.action_dim,
            " whole numbers a step, up to ", most,
            "; a move is one number: number their combinations from 0, or scale continuous actions to [-1, 1]");
    if (rows.action_dim != 1) return 0;
    if (!rows.integer_actions && most <= 1) return 0;
    require(least >= 0 && most < 10000, "dataset.action", path, ": \"actions\" are whole numbers from ", least, " to ",
            most, "; moves are numbered from 0, up to 9999");
    return static_cast<int>(most) + 1;
}

// Flags alone end trajectories, since no time limit is known. Errors: dataset.*, hdf5.*, file.*.
inline OwnData load_own_data(const std::string& path, bool clip) {
    Rows rows = read_data_set(open_hdf5(path));
    const int moves = number_of_moves(rows, path);
    if (clip && moves == 0) clip_actions(rows, path);
    require_sound(rows, path, moves > 0 ? 10000.0f : 1 + 1e-5f);
    const int sizes_limit = 100000;
    require(rows.state_dim <= sizes_limit && rows.action_dim <= sizes_limit, "dataset.shape", path, ": has ",
            rows.state_dim, " state and ", rows.action_dim, " action numbers a step; the most is ", sizes_limit);
    OwnData data{{static_cast<int>(rows.state_dim), static_cast<int>(rows.action_dim), moves, 1},
                 cut_at_flags(rows, std::numeric_limits<size_t>::max())};
    require(!data.trajectories.empty(), "dataset.empty", path,
            ": no step is marked as the end of a trajectory in terminals or timeouts, so there is none");
    const size_t width = std::max(rows.state_dim, rows.action_dim);  // a number of a trajectory is indexed by an int
    for (const Trajectory& trajectory : data.trajectories)
        require(trajectory.rewards.size() <= INT32_MAX / width, "dataset.shape", path, ": a trajectory has ",
                trajectory.rewards.size(), " steps of ", width, " numbers; the most is 2^31 numbers");
    print_remarks(rows, data.trajectories, path, true);
    return data;
}

// Of trajectories in the order of the file, evenly spaced ones are held out, so that they are a `share` of all.
inline bool is_held_out(size_t trajectory, double share) {
    const double i = static_cast<double>(trajectory);
    return std::floor((i + 1) * share) > std::floor(i * share);
}

// The trajectories of own data that are held out, or those that are not (the first is not), with their returns.
// Errors: those of load_own_data().
inline std::vector<Trajectory> part_of_own_data(const Settings& settings, bool held_out) {
    std::shared_ptr<const OwnData> data = settings.own;  // read already, or else by settings from a file
    if (!data) data = std::make_shared<OwnData>(load_own_data(settings.dataset_path, settings.clip_actions));
    std::vector<Trajectory> part;
    for (size_t i = 0; i < data->trajectories.size(); ++i) {
        if (is_held_out(i, settings.held_out) != held_out) continue;
        part.push_back(data->trajectories[i]);
        relabel(part.back(), data->spec.state_dim, data->spec.action_dim, settings.gamma);
    }
    return part;
}

// Writes the first `steps` rows of all arrays under their names in D4RL's files. Errors: file.write.
template <class T>
void write_rows(Hdf5Writer& file, const CollectedRows<T>& rows, size_t steps) {
    rows.each_array([&](const char* name, auto array, bool is_table) {
        const auto& values = rows.*array;
        if (values.empty()) return;
        const size_t width = values.size() / rows.length();
        file.add(name, is_table ? Shape{steps, width} : Shape{steps}, std::span(values).first(steps * width));
    });
}

// Writes episodes as a data set in D4RL's layout, for `info`, `train` and others: raw states, actions (moves in a type
// of whole numbers, by which they are known), rewards, and the last row of each episode marked. Those whose simulation
// broke down are left out. Errors: dataset.empty, file.write.
inline void write_episodes(const std::string& path, const std::vector<Episode>& episodes, bool moves) {
    CollectedRows<float> rows;
    for (const Episode& episode : episodes) {
        if (!episode.error.empty()) continue;
        append_all(rows.observations, episode.trajectory.states);
        append_all(rows.actions, episode.trajectory.actions);
        append_all(rows.rewards, episode.trajectory.rewards);
        for (auto* flags : {&rows.terminals, &rows.timeouts}) flags->resize(rows.rewards.size());
        (episode.trajectory.terminated ? rows.terminals : rows.timeouts).back() = 1;
    }
    require(rows.length() > 0, "dataset.empty", path, ": there is no episode to write");
    Hdf5Writer file(path);
    const std::vector<int32_t> numbers(rows.actions.begin(), rows.actions.end());
    if (moves) rows.actions.clear();
    write_rows(file, rows, rows.length());
    if (moves) file.add("actions", {rows.length(), 1}, numbers);
    file.close();
}

// The offline data of a run with their returns: the grid world's behaviour policy, a file, or uniformly random actions.
// Of own data what is not held out.
inline std::vector<Trajectory> make_data_set(const Settings& settings) {
    if (settings.task == own_data) return part_of_own_data(settings, false);
    std::vector<Trajectory> trajectories;
    const std::unique_ptr<Environment> environment = make_environment(settings);
    const uint32_t seed = static_cast<uint32_t>(settings.data_seed);
    if (settings.task == "gridworld")
        trajectories = collect_data_set(make_grid_world(settings),
                                        static_cast<Behaviour>(index_of(behaviour_names, settings.behaviour)), seed,
                                        static_cast<int>(settings.data_trajectories));
    else if (settings.behaviour == "recorded")
        trajectories = load_data_set(settings.dataset_path, *find_mujoco_task(settings.task), settings);
    else
        for (uint64_t number = 0; trajectories.size() < static_cast<size_t>(settings.data_trajectories); ++number)
            if (auto trajectory = random_trajectory(*environment, seed, number))
                trajectories.push_back(std::move(*trajectory));
    const EnvironmentSpec spec = environment->spec();
    for (Trajectory& trajectory : trajectories) relabel(trajectory, spec.state_dim, spec.action_dim, settings.gamma);
    return trajectories;
}

// ---------------------------------------------------------------------------------------------------------------------
// Statistics of a data set, for `wodtem info`

struct DataSetStatistics {
    Moments lengths, returns, actions;
    size_t terminated = 0;    // trajectories that the task ended
    size_t left_out = 0;      // rows in no trajectory
    size_t dead_columns = 0;  // of the state: always the same number
    size_t repeated = 0;      // rows whose observation is that of the row before
    size_t not_finite = 0;    // numbers, of any kind
    size_t jumps = 0;         // rows within a trajectory whose next observation is not the next row's
    bool has_next = false;
};

inline DataSetStatistics statistics_of(const Rows& rows, const std::vector<Trajectory>& trajectories) {
    DataSetStatistics s;
    for (const Trajectory& trajectory : trajectories) {
        double total = 0;
        for (const float reward : trajectory.rewards) total += reward;
        s.returns.add(total);
        s.lengths.add(trajectory.length());
        s.terminated += trajectory.terminated;
    }
    s.left_out = rows_in_none(rows, trajectories);
    for (const float a : rows.actions) s.actions.add(a);
    const size_t width = rows.state_dim;
    for (size_t column = 0; column < width; ++column) {
        bool dead = true;
        for (size_t row = 1; dead && row < rows.count; ++row)
            dead = rows.observations[row * width + column] == rows.observations[column];
        s.dead_columns += dead;
    }
    for (const auto* values : {&rows.observations, &rows.actions, &rows.rewards, &rows.next_observations})
        s.not_finite += static_cast<size_t>(std::ranges::count_if(*values, [](float x) { return !std::isfinite(x); }));
    s.has_next = !rows.next_observations.empty();
    for (size_t row = 0; row + 1 < rows.count; ++row) {
        const float *here = rows.observation(row), *next = rows.observation(row + 1);
        s.repeated += std::equal(here, here + width, next);
        s.jumps +=
            s.has_next && !rows.ends(row) && !std::equal(next, next + width, &rows.next_observations[row * width]);
    }
    return s;
}

inline std::string describe(const DataSetStatistics& s) {
    char lines[600];
    std::snprintf(lines, sizeof lines,
                  "trajectories: %.0f (%zu ended by the task), %zu rows in none\n"
                  "lengths:      %s\nreturns:      %s\nactions:      %.9g to %.9g\n"
                  "state columns that never change: %zu\nrows that repeat the observation before: %zu\n"
                  "numbers that are not finite: %zu\n",
                  s.lengths.count, s.terminated, s.left_out, s.lengths.text().c_str(), s.returns.text().c_str(),
                  s.actions.low, s.actions.high, s.dead_columns, s.repeated, s.not_finite);
    return lines + (s.has_next ? "next observations that are not the next row's: " + std::to_string(s.jumps) + "\n"
                               : "no next observations: the next row's stand in\n");
}
