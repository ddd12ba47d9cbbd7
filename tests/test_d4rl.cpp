// test_d4rl.cpp: trajectories out of a data set's rows, by hand-made rows for every rule; the search for a file, and
// its name among the settings.
#include <unistd.h>

#include "../data/info.hpp"
#include "hdf5_files.hpp"
#include "test.hpp"

namespace {

// Rows of one state number and one action number each; rewards count rows.
Rows made(const std::vector<float>& states, const std::vector<uint8_t>& terminals,
          const std::vector<uint8_t>& timeouts) {
    Rows rows;
    rows.count = states.size();
    rows.state_dim = rows.action_dim = 1;
    rows.observations = states;
    for (size_t i = 0; i < states.size(); ++i) {
        rows.actions.push_back(states[i] / 100);
        rows.rewards.push_back(static_cast<float>(i));
    }
    rows.terminals = terminals;
    rows.timeouts = timeouts;
    return rows;
}

// "0 1 2! | 3": the rewards, which are row numbers; ! where the task ended the trajectory.
std::string shown(const std::vector<Trajectory>& trajectories) {
    std::string text;
    for (const Trajectory& trajectory : trajectories) {
        text += text.empty() ? "" : " | ";
        for (const float reward : trajectory.rewards)
            text += (text.empty() || text.back() == ' ' ? "" : " ") + std::to_string(static_cast<int>(reward));
        text += trajectory.terminated ? "!" : "";
        CHECK_EQUAL(trajectory.states.size(), trajectory.rewards.size());
        for (size_t i = 0; i < trajectory.states.size(); ++i)
            CHECK_EQUAL(trajectory.actions[i], trajectory.states[i] / 100);
    }
    return text;
}

}  // namespace

TEST(episodes_of_minari_become_rows_and_each_ends_a_trajectory) {
    char name[] = "/tmp/wodtem-test-XXXXXX";
    const std::string folder = mkdtemp(name), path = folder + "/minari";  // known by its signature
    const auto write = [&](uint64_t columns, uint64_t steps) {
        Hdf5Writer out(path);
        const std::vector<double> numbers = {1, 2, 3, 4, 5, 6, 7, 8, 9};
        const auto first = [](const auto& values, uint64_t n) { return std::span(values).first(n); };
        for (const auto& [group, S, T] :
             {std::tuple("episode_0/", uint64_t{2}, uint64_t{2}), {"episode_1/", columns, steps}}) {
            out.add(group + std::string("observations"), {T + 1, S}, first(numbers, (T + 1) * S));
            out.add(group + std::string("actions"), {T, 1}, first(numbers, T));
            out.add(group + std::string("rewards"), {T}, first(numbers, T));
            out.add(group + std::string("terminations"), {T}, first(std::array<uint8_t, 2>{0, 0}, T));
            out.add(group + std::string("truncations"), {T}, first(std::array<uint8_t, 2>{0, 0}, T));
        }
        out.close();
    };
    write(2, 1);
    CHECK(is_hdf5(path));
    const Rows rows = read_data_set(open_hdf5(path));
    CHECK_EQUAL(rows.count, size_t{3});
    CHECK_EQUAL(rows.state_dim, size_t{2});
    CHECK(rows.observations == (std::vector<float>{1, 2, 3, 4, 1, 2}));
    CHECK(rows.next_observations == (std::vector<float>{3, 4, 5, 6, 3, 4}));
    CHECK(rows.actions == (std::vector<float>{1, 2, 1}));
    CHECK_EQUAL(cut_at_flags(rows, 1000).size(), size_t{2});
    for (const auto& [columns, steps] : {std::pair(1, 2), {3, 1}, {0, 1}, {2, 0}}) {
        write(static_cast<uint64_t>(columns), static_cast<uint64_t>(steps));
        CHECK_FAILS("dataset.shape", read_data_set(open_hdf5(path)));
    }
    {
        Hdf5Writer out(path);
        out.add("observations", {2, 1, 1}, std::array{1.0f, 2.0f});
        out.close();
    }
    CHECK_FAILS("dataset.shape", read_data_set(open_hdf5(path)));
    const std::string whole = read_file(path);
    write_file_atomic(path, std::string(1024, ' ') + whole);  // a user block
    CHECK(is_hdf5(path));
    write_file_atomic(path, std::string(1000, ' ') + whole);
    CHECK(!is_hdf5(path) && is_hdf5(path + ".h5"));
    std::filesystem::remove_all(folder);
}

namespace {

// A file of hand-made data sets, removed at its end.
struct MadeFile {
    std::string folder = [] {
        char name[] = "/tmp/wodtem-test-XXXXXX";
        return std::string(mkdtemp(name));
    }();
    std::string path = folder + "/made.hdf5";
    ~MadeFile() { std::filesystem::remove_all(folder); }

    // Each data set has a column of 1, 2, ..., or flags.
    Hdf5File with(const std::map<std::string, uint64_t>& columns,
                  const std::map<std::string, std::vector<uint8_t>>& flags) const {
        Hdf5Writer out(path);
        for (const auto& [name, rows] : columns) {
            std::vector<float> values(rows);
            std::iota(values.begin(), values.end(), 1.0f);
            out.add(name, {rows, 1}, values);
        }
        for (const auto& [name, values] : flags) out.add(name, {values.size()}, values);
        out.close();
        return open_hdf5(path);
    }
};

}  // namespace

TEST(episodes_of_minari_whose_numbers_have_gaps_are_all_read) {
    const MadeFile made_file;
    std::map<std::string, uint64_t> columns;
    std::map<std::string, std::vector<uint8_t>> flags;
    for (const auto& [episode, steps] : std::map<int, uint64_t>{{2, 1}, {10, 3}, {7, 2}}) {
        const std::string group = "episode_" + std::to_string(episode) + "/";
        columns[group + "observations"] = steps + 1;
        columns[group + "actions"] = columns[group + "rewards"] = steps;
        flags[group + "terminations"] = flags[group + "truncations"] = std::vector<uint8_t>(steps, 0);
    }
    Hdf5File file = made_file.with(columns, flags);
    CHECK(is_minari(file));
    const Rows rows = read_minari(file);
    CHECK(rows.observations == (std::vector<float>{1, 1, 2, 1, 2, 3}));  // episodes 2, 7 and 10
    CHECK(rows.timeouts == (std::vector<uint8_t>{1, 0, 1, 0, 0, 1}));
    file.attributes["total_episodes"] = 3;
    CHECK_EQUAL(read_minari(file).count, size_t{6});
    for (const double stated : {2.0, 4.0, 0.0}) {
        file.attributes["total_episodes"] = stated;
        CHECK_FAILS("dataset.episodes", read_minari(file));
    }
    file.attributes["total_episodes"] = 3;
    for (const auto& [steps, id] : {std::pair(6.0, ""), {5.0, "dataset.episodes"}, {7.0, "dataset.episodes"}}) {
        file.attributes["total_steps"] = steps;
        if (*id)
            CHECK_FAILS(id, read_minari(file));
        else
            CHECK_EQUAL(read_minari(file).count, size_t{6});
    }
    for (const auto& [name, length, known] :
         {std::tuple("dones", 2, false), {"dones", 1, true}, {"infos/dones", 2, true}}) {
        std::map<std::string, uint64_t> more = columns;
        more[std::string("episode_7/") + name] = static_cast<uint64_t>(length);
        const Hdf5File with_more = made_file.with(more, flags);
        if (known)
            CHECK_EQUAL(read_minari(with_more).count, size_t{6});
        else
            CHECK_FAILS("dataset.column", read_minari(with_more));
    }
    const auto says = [&](const std::map<std::string, uint64_t>& some, const std::string& end) {
        try {
            read_data_set(made_file.with(some, flags));
            CHECK(!"read");
        } catch (const Error& error) {
            CHECK(error.id == "dataset.shape" && std::string(error.what()).ends_with(end));
        }
    };
    std::map<std::string, uint64_t> fewer = columns;
    fewer.erase("episode_7/rewards");
    says(fewer, "\"episode_7/rewards\"; in Minari's layout each episode has it");
    columns["episode_3/infos/x"] = 1;  // an episode of which a part is missing
    CHECK_FAILS("dataset.shape", read_minari(made_file.with(columns, flags)));
    columns.erase("episode_3/infos/x");
    for (const char* stray : {"episode_03/observations", "episode_x/observations", "observations"}) {
        std::map<std::string, uint64_t> more = columns;
        more[stray] = 2;
        CHECK_FAILS("dataset.column", read_minari(made_file.with(more, flags)));
    }
    columns.erase("episode_2/observations");
    columns["episode_2/observations/achieved_goal"] = 2;
    try {
        read_minari(made_file.with(columns, flags));
    } catch (const Error& error) {
        CHECK(std::string(error.what())
                  .ends_with("\"episode_2/observations\" is a group; write one table of numbers "
                             "instead, or name a maze's task"));
    }
}

namespace {

// A file that Minari wrote: tests/hdf5/NAME.z, as make.py says.
Hdf5File file_of_minari(const std::string& name) { return parse_hdf5(hdf5_bytes(name), name); }

std::vector<std::string> remarks_of(const Rows& rows, const MujocoTask& task, const std::string& physics) {
    return remarks_on(rows, task, physics, transitions_of_each_physics(rows, task));
}

bool some_contain(const std::vector<std::string>& sentences, const std::string& part) {
    return std::ranges::any_of(sentences, [&](const auto& one) { return one.find(part) != std::string::npos; });
}

}  // namespace

// The map has 8 rows and 8 columns, whose middle is at 4, so x = 4 - 0.7 - Y and y = 4 - 0.7 + X: by hand for one row,
// by the engine for each: where no wall is near, our ball moves as Minari's did.
TEST(pointmaze_of_minari_is_maze2d_turned_and_moved) {
    const MujocoTask& task = *find_mujoco_task("maze2d-medium-v1");
    const Hdf5File file = file_of_minari("pointmaze");
    const Rows rows = read_minari(file, &task);
    CHECK_EQUAL(rows.count, size_t{24});
    CHECK_EQUAL(rows.state_dim, size_t{4});
    const std::vector<float> first(rows.observation(12), rows.observation(12) + 4);
    CHECK(first == (std::vector<float>{3.3f + 0.59408427f, 3.3f - 1.27567528f, 0, 0}));
    CHECK(rows.actions[24] == 0.23264489f && rows.actions[25] == 0.23077023f);
    CHECK(std::ranges::all_of(rows.rewards, [](float reward) { return reward == 0; }));
    CHECK_EQUAL(file.find("episode_0/rewards")->type, "int64");
    CHECK(rows.timeouts[11] == 1 && rows.timeouts[23] == 1 && std::ranges::count(rows.timeouts, 1) == 2);
    CHECK(rows_outside(rows, task).empty());
    const std::vector<std::string> remarks = remarks_of(rows, task, "d4rl");
    CHECK_EQUAL(remarks.size(), size_t{1});
    CHECK(some_contain(remarks, "the state is observation") && some_contain(remarks, "0.45"));
#ifdef WODTEM_MUJOCO
    MujocoEnvironment environment(task, Physics::d4rl);
    size_t same = 0;
    for (size_t row = 0; row < rows.count; ++row) {
        const float* const s = rows.observation(row);
        environment.start(std::vector<double>{s[0], s[1]}, std::vector<double>{s[2], s[3]});
        environment.advance(std::vector<double>{rows.actions[2 * row], rows.actions[2 * row + 1]});
        double difference = 0;
        for (size_t i = 0; i < 4; ++i)
            difference =
                std::max(difference, std::fabs(environment.observation[i] - rows.next_observations[4 * row + i]));
        same += difference < 1e-6;
    }
    CHECK(same >= 20);
#endif
    CHECK_FAILS("dataset.shape", read_minari(file));
    CHECK_FAILS("dataset.shape", read_minari(file, find_mujoco_task("hopper")));
}

#ifdef WODTEM_MUJOCO
// Gymnasium's Hopper-v5 on MuJoCo 3.4.0 is, but for the reward, that of physics 2.2; our own data are of their physics.
TEST(recorded_transitions_tell_the_bodies_that_made_them) {
    const MujocoTask& hopper = *find_mujoco_task("hopper");
    const Rows rows = read_minari(file_of_minari("hopper"));
    const auto largest = [&](const Rows& data, Physics physics) {
        const std::vector<Transition> differences = transition_differences(data, hopper, physics);
        CHECK(differences.size() > 20 && std::ranges::is_sorted(differences));
        return differences.back().difference;
    };
    CHECK(largest(rows, Physics::mujoco_2_2) < 1e-5);  // the observations of the file, in float
    CHECK(largest(rows, Physics::d4rl) > 1e-3);
    CHECK(some_contain(remarks_of(rows, hopper, "d4rl"), "choose these with --physics 2.2"));
    CHECK(remarks_of(rows, hopper, "2.2").empty());
    Rows own;
    MujocoEnvironment environment(hopper, Physics::d4rl);
    own.state_dim = 11;
    own.action_dim = 3;
    for (uint64_t episode = 0; own.count < 450; ++episode) {
        const auto trajectory = random_trajectory(environment, 1, episode);
        append_all(own.observations, trajectory->states);
        append_all(own.actions, trajectory->actions);
        own.count += trajectory->rewards.size();
        own.terminals.resize(own.count);
        own.terminals.back() = 1;
    }
    CHECK(largest(own, Physics::d4rl) < 1e-4);
    CHECK(largest(own, Physics::mujoco_2_2) > 1e-3);
    own.of_minari = true;  // which does not make them Gymnasium's
    CHECK(remarks_of(own, hopper, "d4rl").empty());
    CHECK(some_contain(remarks_of(own, hopper, "2.2"), "choose these with --physics d4rl"));
    Rows spoilt = own;
    size_t row = 99;  // of 450 rows, 200 are taken again: 0, 2, 4, 6, 9, ...
    while (own.ends(row)) row += 9;
    CHECK(!first_far_off(transition_differences(own, hopper, Physics::d4rl)));
    spoilt.observations[(row + 1) * 11] += 1;  // a step to elsewhere
    CHECK(first_far_off(transition_differences(spoilt, hopper, Physics::d4rl)) == row);
    CHECK(remarks_of(spoilt, hopper, "d4rl").empty());
    for (size_t i = 0; i < spoilt.observations.size(); ++i)  // what no body did
        spoilt.observations[i] = static_cast<float>((i * 37) % 251) / 251;
    for (const char* physics : {"d4rl", "2.2"})
        CHECK(some_contain(remarks_of(spoilt, hopper, physics), "neither physics made these data") &&
              some_contain(remarks_of(spoilt, hopper, physics), "first in row 0; are they of hopper"));
    own.observations[5] = 10;  // row 0: a velocity at its limit
    CHECK(transition_differences(own, hopper, Physics::d4rl).size() < 200);
    own.actions.assign(own.actions.size(), NAN);
    CHECK(transition_differences(own, hopper, Physics::d4rl).empty());
}
#endif

TEST(antmaze_of_minari_has_its_position_in_front) {
    const MujocoTask& task = *find_mujoco_task("antmaze-umaze-v2");
    const Rows rows = read_minari(file_of_minari("antmaze"), &task);
    CHECK_EQUAL(rows.count, size_t{6});
    CHECK_EQUAL(rows.state_dim, size_t{29});
    const float* const s = rows.observation(3);
    CHECK_CLOSE(s[0], -0.3763371, 1e-6);
    CHECK_CLOSE(s[1], -4.1533471, 1e-6);
    CHECK(s[2] == 0.75f && s[3] == 1 && s[4] == 0);
    CHECK_EQUAL(rows.actions[3 * 8 + 7], -0.22215715f);
    CHECK(std::equal(s + 29, s + 58, &rows.next_observations[3 * 29]));
    CHECK(some_contain(remarks_of(rows, task, "d4rl"), "the state is achieved_goal and observation"));
}

TEST(a_folder_of_minari_stands_for_its_file) {
    const MadeFile made_file;
    const std::string folder = made_file.folder + "/set";
    std::filesystem::create_directories(folder + "/data");
    CHECK_FAILS("dataset.folder", data_set_file(folder));
    CHECK_EQUAL(data_set_file(folder + "/gone"), folder + "/gone");
    write_file_atomic(folder + "/data/main_data.hdf5", "x");
    CHECK_EQUAL(data_set_file(folder), folder + "/data/main_data.hdf5");
    CHECK_EQUAL(data_set_file(folder + "/data"), folder + "/data/main_data.hdf5");
    const std::string arrow = made_file.folder + "/arrow";
    std::filesystem::create_directories(arrow + "/data/0");
    write_file_atomic(arrow + "/data/0/part-0.arrow", "ARROW1");
    for (const char* below : {"", "/data", "/data/0", "/data/0/part-0.arrow"})
        CHECK_FAILS("dataset.arrow", data_set_file(arrow + below));
    for (const auto& [path, name] : {std::pair("/x/own/a-v0/data/main_data.hdf5", "own-a-v0.hdf5"),
                                     {"/x/hopper/medium-v0.1/main_data.hdf5", "hopper-medium-v0.1.hdf5"},
                                     {"/a/main_data.hdf5", "main_data.hdf5"},
                                     {"/data/main_data.hdf5", "main_data.hdf5"},
                                     {"/x/own/data/a.hdf5", "a.hdf5"}})
        CHECK_EQUAL(data_set_name(path), name);
}

// Cells of umaze's map: (1, 1) is the goal's, (2, 1) a wall; 0.2 lies between observed positions and cells.
TEST(positions_outside_the_maze_are_said_and_many_are_refused) {
    const MujocoTask& task = *find_mujoco_task("maze2d-umaze-v1");
    const MadeFile made_file;
    const auto with = [&](const std::vector<std::array<float, 2>>& places, size_t rows) {
        std::vector<float> states;
        for (size_t row = 0; row < rows; ++row) {
            const auto [x, y] = row < places.size() ? places[row] : std::array{0.8f, 0.8f};
            states.insert(states.end(), {x, y, 0, 0});
        }
        std::vector<uint8_t> ends(rows);
        ends.back() = 1;
        Hdf5Writer out(made_file.path);
        out.add("observations", {rows, 4}, states);
        out.add("actions", {rows, 2}, std::vector<float>(2 * rows));
        out.add("rewards", {rows}, std::vector<float>(rows));
        out.add("terminals", {rows}, std::vector<uint8_t>(rows));
        out.add("timeouts", {rows}, ends);
        out.close();
        return rows_outside(read_data_set(open_hdf5(made_file.path)), task).size();
    };
    CHECK_EQUAL(with({{0.31f, 0.31f}, {1.29f, 0.31f}, {1.29f, 1.29f}, {0.31f, 3.29f}}, 9), size_t{0});
    CHECK_EQUAL(with({{1.31f, 0.8f}, {0.29f, 0.8f}, {-1, -1}, {0.8f, 9}, {1e30f, 0.8f}, {0.8f, NAN}, {4, 4}}, 9),
                size_t{7});
    CHECK_EQUAL(with({{-1, -1}}, 100), size_t{1});
    CHECK_EQUAL(load_data_set(made_file.path, task).size(), size_t{1});
    CHECK_EQUAL(with({{-1, -1}}, 99), size_t{1});
    try {
        load_data_set(made_file.path, task);
        CHECK(!"loaded");
    } catch (const Error& error) {
        CHECK_EQUAL(error.id, "dataset.place");
        CHECK(std::string(error.what()).find("1 of 99 positions lie in no free cell of maze2d-umaze, first in row 0") !=
              std::string::npos);
    }
}

TEST(data_of_other_bodies_are_named_before_training) {
    const MujocoTask &hopper = *find_mujoco_task("hopper"), &ant = *find_mujoco_task("ant");
    Rows rows;  // none, so that no step tells
    rows.state_dim = 11;
    CHECK(remarks_of(rows, hopper, "d4rl").empty());
    rows.of_minari = true;
    CHECK(some_contain(remarks_of(rows, hopper, "d4rl"), "if Gymnasium made the data"));
    CHECK(remarks_of(rows, hopper, "2.2").empty());
    CHECK(remarks_of(rows, *find_mujoco_task("antmaze-umaze-v2"), "d4rl").empty());
    rows.of_minari = false;
    rows.state_dim = 111;
    rows.observations.assign(222, 0);
    rows.observations[111 + 26] = 1;  // the last velocity
    CHECK(remarks_of(rows, ant, "d4rl").empty());
    rows.observations[111 + 27] = 1e-3f;
    CHECK(some_contain(remarks_of(rows, ant, "2.2"), "contact forces"));
}

TEST(what_marks_the_ends_of_episodes_is_understood_or_refused) {
    const MadeFile made_file;
    const std::map<std::string, uint64_t> columns = {{"observations", 6}, {"actions", 6}, {"rewards", 6}};
    using Flags = std::vector<uint8_t>;
    const Flags terminals = {0, 1, 0, 0, 0, 0}, ends = {0, 1, 0, 1, 0, 1};
    // d3rlpy 1's ends include those that the task set, which are no timeouts.
    const Rows rows = read_rows(made_file.with(columns, {{"terminals", terminals}, {"episode_terminals", ends}}));
    CHECK(rows.timeouts == (Flags{0, 0, 0, 1, 0, 1}));
    std::string lengths;
    for (const Trajectory& trajectory : cut_at_flags(rows, 1000))
        lengths += std::to_string(trajectory.length()) + (trajectory.terminated ? "! " : " ");
    CHECK_EQUAL(lengths, "2! 2 2 ");
    CHECK(read_rows(made_file.with(columns, {{"terminals", terminals}})).timeouts.empty());
    CHECK(read_rows(made_file.with(columns, {{"terminals", terminals}, {"timeouts", ends}})).timeouts == ends);
    for (const char* name : {"episode_terminals", "truncations", "dones"}) {
        try {
            read_rows(made_file.with(columns, {{"terminals", terminals}, {"timeouts", ends}, {name, ends}}));
            CHECK(!"read");
        } catch (const Error& error) {
            CHECK_EQUAL(error.id, "dataset.column");
            CHECK(std::string(error.what()).find("\"" + std::string(name) + "\": has a row for each") !=
                  std::string::npos);
        }
    }
    try {
        read_rows(made_file.with({{"ep_0/observations", 6}}, {}));
        CHECK(!"read");
    } catch (const Error& error) {
        CHECK(std::string(error.what())
                  .ends_with("it is in neither D4RL's layout nor Minari's "
                             "(episode_0/observations)"));
    }
    // Of another length, or below a group, it is no column of the table.
    read_rows(made_file.with(columns, {{"terminals", terminals}, {"version", {1}}, {"infos/dones", ends}}));
}

TEST(episodes_of_minari_end_as_their_flags_say_and_at_the_latest_with_their_group) {
    const MadeFile made_file;
    std::map<std::string, uint64_t> columns;
    std::map<std::string, std::vector<uint8_t>> flags;
    for (uint8_t episode = 0; episode < 3; ++episode) {
        const std::string group = "episode_" + std::to_string(episode) + "/";
        columns[group + "observations"] = 3;
        columns[group + "actions"] = columns[group + "rewards"] = 2;
        flags[group + "terminations"] = {0, episode == 0};
        flags[group + "truncations"] = {0, episode == 1};
    }
    const Rows rows = read_minari(made_file.with(columns, flags));
    CHECK(rows.terminals == (std::vector<uint8_t>{0, 1, 0, 0, 0, 0}));
    CHECK(rows.timeouts == (std::vector<uint8_t>{0, 0, 0, 1, 0, 1}));
}

TEST(written_episodes_keep_their_ends_and_those_that_broke_down_are_left_out) {
    const MadeFile made_file;
    std::vector<Episode> episodes(3);
    for (size_t i = 0; i < 3; ++i)
        episodes[i].trajectory = {{1, 2}, {0.5f, 0.25f}, {3, static_cast<float>(i)}, i == 0, {}, {}};
    episodes[1].error = "broken";
    write_episodes(made_file.path, episodes, false);
    const Rows rows = read_rows(open_hdf5(made_file.path));
    CHECK(rows.rewards == (std::vector<float>{3, 0, 3, 2}));
    CHECK(rows.terminals == (std::vector<uint8_t>{0, 1, 0, 0}));
    CHECK(rows.timeouts == (std::vector<uint8_t>{0, 0, 0, 1}));
    CHECK_FAILS("dataset.empty", write_episodes(made_file.path, {episodes[1]}, false));
}

// Medians of three steps each; the second is as far off as a step must be to count.
TEST(the_remark_on_bodies_has_the_medians_of_both_physics) {
    const auto remark = [](const std::array<double, 3>& d4rl, const std::array<double, 3>& other, const char* physics) {
        TransitionsOfPhysics transitions;
        for (size_t i = 0; i < 3; ++i)
            transitions[0].push_back({d4rl[i], 9 - i}), transitions[1].push_back({other[i], i});
        return remark_on_bodies(Rows{}, *find_mujoco_task("hopper"), physics, transitions);
    };
    CHECK_EQUAL(
        remark({0, 0.5, 9}, {0, 0.03125, 9}, "d4rl"),
        "other bodies made these data: recorded steps taken again end 0.5 from the recorded state under physics "
        "d4rl, 0.03125 under 2.2; choose these with --physics 2.2");
    CHECK_EQUAL(remark({0, 0.5, 9}, {0, far_off / 2, 9}, "2.2"), "");
    CHECK_EQUAL(remark({0, far_off, 1}, {0, 0.5, 9}, "d4rl"),
                "neither physics made these data: recorded steps taken again end 0.001 from the recorded state under "
                "physics d4rl, 0.5 under 2.2 (medians), first in row 7; are they of hopper, and in the units of its "
                "states?");
    CHECK(first_far_off({{0, 1}, {far_off, 4}}) == size_t{4});
    CHECK(!first_far_off({{0, 1}, {far_off / 2, 4}}));
}

TEST(trajectories_end_at_terminals_and_timeouts_and_a_tail_without_a_flag_is_none) {
    const Rows rows = made({5, 6, 7, 8, 9, 1, 2, 3}, {0, 0, 1, 0, 0, 0, 0, 0}, {0, 0, 0, 0, 0, 1, 0, 0});
    CHECK_EQUAL(shown(cut_at_flags(rows, 1000)), "0 1 2! | 3 4 5");
    const DataSetStatistics s = statistics_of(rows, cut_at_flags(rows, 1000));
    CHECK_EQUAL(s.left_out, size_t{2});
    CHECK_EQUAL(statistics_of(rows, {}).returns.text(), "none");
    CHECK_EQUAL(s.terminated, size_t{1});
    CHECK_CLOSE(s.returns.mean(), (0 + 1 + 2 + 3 + 4 + 5) / 2.0, 1e-12);
    CHECK_CLOSE(s.returns.deviation(), 4.5, 1e-12);  // of 3 and 12
    CHECK_CLOSE(s.lengths.mean(), 3, 1e-12);
}

TEST(a_step_with_only_a_timeout_is_no_termination_and_one_with_both_is) {
    CHECK_EQUAL(shown(cut_at_flags(made({1, 2, 3, 4}, {0, 0, 0, 1}, {0, 1, 0, 1}), 1000)), "0 1 | 2 3!");
}

TEST(without_timeouts_the_time_limit_ends_a_trajectory_too) {
    CHECK_EQUAL(shown(cut_at_flags(made({1, 2, 3, 4, 5, 6, 7, 8}, {0, 1, 0, 0, 0, 0, 0, 0}, {}), 3)),
                "0 1! | 2 3 4 | 5 6 7");
}

// With cut=episodes the file's own timeouts do not count: maze2d-umaze is cut every 300 rows, and 100 are left over.
TEST(cut_by_episodes_maze_data_end_at_the_time_limit_alone) {
    const MadeFile made_file;
    std::vector<uint8_t> timeouts(700), terminals(700);
    timeouts[99] = timeouts[449] = 1;
    Hdf5Writer out(made_file.path);
    out.add("observations", {700, 4}, std::vector<float>(2800, 1));  // in the goal's cell
    out.add("actions", {700, 2}, std::vector<float>(1400));
    out.add("rewards", {700}, std::vector<float>(700));
    out.add("terminals", {700}, terminals);
    out.add("timeouts", {700}, timeouts);
    out.close();
    const auto lengths = [&](const char* rule) {
        Settings settings;
        settings.cut = rule;
        std::vector<int> all;
        for (const Trajectory& trajectory :
             load_data_set(made_file.path, *find_mujoco_task("maze2d-umaze-v1"), settings))
            all.push_back(trajectory.length());
        return all;
    };
    CHECK(lengths("flags") == (std::vector<int>{100, 350}));
    CHECK(lengths("episodes") == (std::vector<int>{300, 300}));
}

// Rows 2 and 6 (timeouts) and 7 (the last) are no tuples; 1 does not lead to 3, 4 ends by itself, 5 is the last tuple.
TEST(antmaze_is_cut_where_tuples_do_not_go_on_and_at_every_terminal) {
    CHECK_EQUAL(
        shown(cut_tuples(made({0, 1, 2, 10, 11, 12, 13, 20}, {0, 0, 0, 0, 1, 0, 0, 0}, {0, 0, 1, 0, 0, 0, 1, 0}), 700)),
        "0 1 | 3 4! | 5");
    // Success goes on: each row at the goal is a trajectory of its own, as in ODT.
    CHECK_EQUAL(shown(cut_tuples(made({0, 1, 2, 3, 4, 5}, {0, 0, 1, 1, 1, 0}, {0, 0, 0, 0, 0, 0}), 700)),
                "0 1 2! | 3! | 4!");
    // A timeout whose next episode starts where its next row stood joins them: only states tell.
    CHECK_EQUAL(shown(cut_tuples(made({0, 1, 2, 2, 3, 4}, {0, 0, 0, 0, 0, 0}, {0, 0, 1, 0, 0, 0}), 700)), "0 1 3 4");
    CHECK_EQUAL(shown(cut_tuples(made({0}, {0}, {0}), 700)), "");
    // Without timeouts every third step of an episode is one: 2, and 6, for 3 ends an episode.
    CHECK_EQUAL(shown(cut_tuples(made({0, 1, 2, 10, 20, 21, 22, 30, 31}, {0, 0, 0, 1, 0, 0, 0, 0, 0}, {}), 3)),
                "0 1 | 3! | 4 5 | 7");
    MujocoTask tiny = *find_mujoco_task("antmaze-umaze");
    tiny.state_dim = tiny.action_dim = 1;
    tiny.max_episode_steps = 3;
    CHECK_EQUAL(cut_trajectories(made({0, 1, 2, 10, 11, 12, 20, 21}, {0, 0, 0, 0, 0, 0, 0, 0}, {}), tiny, "f").size(),
                size_t{3});
}

TEST(statistics_count_dead_columns_repetitions_and_jumps) {
    Rows rows = made({4, 4, 5, 6}, {0, 0, 0, 1}, {});
    rows.state_dim = 2;
    rows.observations = {4, 0, 4, 0, 5, 0, 6, 0};
    rows.next_observations = {4, 0, 5, 0, 9, 0, 7, 0};
    const DataSetStatistics s = statistics_of(rows, cut_at_flags(rows, 1000));
    CHECK_EQUAL(s.dead_columns, size_t{1});
    CHECK_EQUAL(s.repeated, size_t{1});
    CHECK_EQUAL(s.jumps, size_t{1});
    CHECK_EQUAL(s.not_finite, size_t{0});
    CHECK_CLOSE(s.actions.low, 0.04, 1e-7);
    rows.actions[3] = NAN;
    CHECK_EQUAL(statistics_of(rows, cut_at_flags(rows, 1000)).not_finite, size_t{1});
}

TEST(a_data_set_is_described_by_what_was_counted) {
    DataSetStatistics s;
    for (const double length : {2.0, 4.0}) s.lengths.add(length);
    for (const double total : {-1.0, 5.0}) s.returns.add(total);
    for (const double a : {-0.5, 0.25}) s.actions.add(a);
    s.terminated = 1, s.left_out = 3, s.dead_columns = 4, s.repeated = 5, s.not_finite = 6, s.jumps = 7;
    const std::string text =
        "trajectories: 2 (1 ended by the task), 3 rows in none\nlengths:      mean 3.00, deviation 1.00, 2.00 to 4.00\n"
        "returns:      mean 2.00, deviation 3.00, -1.00 to 5.00\nactions:      -0.5 to 0.25\n"
        "state columns that never change: 4\nrows that repeat the observation before: 5\n"
        "numbers that are not finite: 6\n";
    CHECK_EQUAL(describe(s), text + "no next observations: the next row's stand in\n");
    s.has_next = true;
    CHECK_EQUAL(describe(s), text + "next observations that are not the next row's: 7\n");
}

// Returns of 3 and 6, so 4.5 on hopper's scale from -20.272305 to 3234.3.
TEST(info_tells_the_score_of_the_mean_what_is_published_and_how_much_it_does_not_list) {
    const MadeFile made_file;
    Hdf5Writer out(made_file.path);
    out.add("observations", {3, 11}, std::vector<float>(33));
    out.add("actions", {3, 3}, std::vector<float>(9));
    out.add("rewards", {3}, std::vector<float>{1, 2, 6});
    out.add("terminals", {3}, std::vector<uint8_t>{0, 1, 1});
    for (int i = 0; i < 41; ++i) out.add("infos/" + std::to_string(i), {1}, std::vector<float>(1));
    out.close();
    const std::string text = printed([&] { print_data_set(made_file.path, "hopper-medium-v2"); });
    for (const char* line :
         {"\n  and 5 more\n", "\nrows:         3, 11 state and 3 action numbers\ntrajectories: 2 (2 ended",
          "\nmean normalised score of a trajectory: 0.76 (hopper)\n"})
        CHECK(text.find(line) != std::string::npos);
    CHECK_EQUAL(printed([] { print_published(find_published("ant-medium-v2")); }),
                "D4RL's: 1202 trajectories, mean return 3051.26\n");
    CHECK_EQUAL(printed([] { print_published(find_published("maze2d-umaze-v1")); }), "");
}

TEST(the_list_of_tasks_has_their_sizes_and_reference_returns) {
    const std::string text = printed(print_tasks);
    const std::string space(16, ' ');
    for (const std::string& line :
         {"\nhopper-medium-v2" + space +
              "11 state numbers, 3 action numbers, at most 1000 steps; score 0 is a return of "
              "-20.272305, 100 3234.3\n",
          "\nantmaze-umaze-v2" + space +
              "29 state numbers, 8 action numbers, at most 700 steps; score 0 is a return of "
              "0, 100 1\n"})
        CHECK(text.find(line) != std::string::npos);
    CHECK(text.starts_with("gridworld                        2 state numbers, 8 moves, at most 100 steps; "));
}

TEST(the_range_of_a_tensor_is_that_of_its_finite_numbers) {
    CHECK_EQUAL(value_range({3, NAN, 1, 2, INFINITY, -2}), "-2 to 3, mean 1, NOT FINITE: 2");
    CHECK_EQUAL(value_range({NAN}), "nothing finite");
}

TEST(numbers_that_nobody_can_learn_from_are_refused_where_they_are) {
    const Rows sound = made({1, 2, 3}, {0, 0, 1}, {});
    const auto said = [](const Rows& rows) {
        try {
            require_sound(rows, "f");
        } catch (const Error& error) {
            return error.id + " " + error.what();
        }
        return std::string();
    };
    CHECK_EQUAL(said(sound), "");
    Rows rows = sound;
    rows.observations[1] = NAN;
    CHECK_EQUAL(
        said(rows),
        "dataset.not_finite f: \"observations\", row 1, column 0 is nan; only finite numbers can be learned from");
    rows = sound;
    rows.rewards[2] = -INFINITY;
    CHECK_EQUAL(said(rows),
                "dataset.not_finite f: \"rewards\", row 2, column 0 is -inf; only finite numbers can be learned from");
    rows = sound;
    rows.actions[0] = -1.000001f;  // by rounding
    CHECK_EQUAL(said(rows), "");
    rows.actions[0] = -1.001f;
    CHECK_EQUAL(said(rows),
                "dataset.action f: \"actions\", row 0, column 0 is -1.001; actions lie in [-1, 1]: is it of another "
                "task, or not scaled? Where they are commands that a machine cut off, --clip-actions does the same");
    clip_actions(rows, "f");
    CHECK_EQUAL(said(rows), "");
    CHECK_EQUAL(rows.actions[0], -1.0f);
    rows.actions[0] = INFINITY;  // is no command
    clip_actions(rows, "f");
    CHECK(said(rows).starts_with("dataset.not_finite"));
    rows.actions[0] = NAN;
    CHECK_EQUAL(said(rows),
                "dataset.not_finite f: \"actions\", row 0, column 0 is nan; only finite numbers can be learned from");
}

TEST(an_observation_or_a_reward_that_would_drown_all_others_is_named) {
    Rows rows;
    rows.count = 2000, rows.state_dim = 2, rows.rewards.assign(2000, 0);
    for (size_t i = 0; i < 4000; ++i) rows.observations.push_back(static_cast<float>(i * 7 % 13));
    CHECK_EQUAL(remark_on_outliers(rows), "");
    rows.observations[2 * 1500 + 1] = 600000;  // the others lie in a thousandth of the deviation, 13400
    CHECK(remark_on_outliers(rows).starts_with("\"observations\", row 1500, column 1 is 600000, so far from most"));
    rows.observations[2 * 1500 + 1] = 6000;
    CHECK_EQUAL(remark_on_outliers(rows), "");
    rows.observations[2 * 7] = -1e38f, rows.observations[2 * 8] = 1e37f;  // the farthest of several is named
    CHECK(remark_on_outliers(rows).starts_with("\"observations\", row 7, column 0 is -1e+38, so far from most"));
    for (size_t row = 0; row < 2000; ++row) rows.observations[2 * row] = 3;  // a dead column has none
    CHECK_EQUAL(remark_on_outliers(rows), "");
    rows.rewards[9] = 1;  // rewards that are nearly always 0 are common
    CHECK_EQUAL(remark_on_outliers(rows), "");
    for (size_t row = 0; row < 2000; ++row) rows.rewards[row] = static_cast<float>(row % 5);
    CHECK_EQUAL(remark_on_outliers(rows), "");
    rows.rewards[11] = 1e38f;
    CHECK(remark_on_outliers(rows).starts_with("\"rewards\", row 11 is 1e+38, so far from most"));
}

TEST(rows_of_another_size_or_without_an_end_are_refused) {
    const MujocoTask& hopper = *find_mujoco_task("hopper");
    CHECK_FAILS("dataset.task", cut_trajectories(made({1, 2}, {0, 1}, {}), hopper, "f"));
    try {
        cut_trajectories(made({1, 2}, {0, 1}, {}), hopper, "f");
    } catch (const Error& error) {
        CHECK(
            std::string(error.what()).starts_with("f: has 1 state and 1 action numbers a step; hopper has 11 and 3: "));
    }
    MujocoTask tiny = hopper;
    tiny.state_dim = tiny.action_dim = 1;
    CHECK_FAILS("dataset.empty", cut_trajectories(made({1, 2}, {0, 0}, {}), tiny, "f"));
    CHECK_EQUAL(cut_trajectories(made({1, 2}, {0, 1}, {}), tiny, "f").size(), size_t{1});
}

TEST(moves_are_whole_numbers_of_an_integer_type_or_with_one_above_one) {
    Rows rows;
    rows.action_dim = 1;
    for (const auto& [actions, integers, moves] : {std::tuple<std::vector<float>, bool, int>{{0, 1, 0, 1}, false, 0},
                                                   {{0, 1, 0, 1}, true, 2},
                                                   {{0, 1, 2, 1}, false, 3},
                                                   {{0, 1, 2.5f, 1}, false, 0}}) {
        rows.actions = actions;
        rows.integer_actions = integers;
        CHECK_EQUAL(number_of_moves(rows, "f"), moves);
    }
    rows.actions = {-1, 2};
    CHECK_FAILS("dataset.action", number_of_moves(rows, "f"));
    rows.actions = {0, 9999};
    CHECK_EQUAL(number_of_moves(rows, "f"), 10000);
    rows.actions = {0, 10000};
    CHECK_FAILS("dataset.action", number_of_moves(rows, "f"));
    rows.action_dim = 2;  // several choices a step, which clipping would spoil
    rows.integer_actions = true;
    CHECK_FAILS("dataset.action", number_of_moves(rows, "f"));
    rows.actions = {-1, 1};
    CHECK_EQUAL(number_of_moves(rows, "f"), 0);
}

TEST(the_data_of_the_grid_world_are_drawn_by_the_seed_of_the_data_alone) {
    Settings settings = default_settings("gridworld", "odt", "small");
    set_from(settings, "data_trajectories", "20", "command line");
    const auto states = [&](long seed, const char* data_seed) {
        settings.seed = seed;
        set_from(settings, "data_seed", data_seed, "command line");
        std::vector<float> all;
        for (const Trajectory& trajectory : make_data_set(settings)) append_all(all, trajectory.states);
        return all;
    };
    CHECK(states(0, "5") == states(1, "5"));
    CHECK(states(0, "5") != states(0, "6"));
}

TEST(larger_budgets_are_those_of_the_phase_that_a_run_ends_with) {
    Settings found = default_settings("gridworld", "odt", "small"), wanted = found;
    found.offline_updates = 100, found.online_steps = 500;
    wanted.offline_updates = 200, wanted.online_steps = 700;
    const Settings online = with_larger_budgets(found, wanted);
    CHECK(online.offline_updates == 100 && online.online_steps == 700);
    found.online_steps = wanted.online_steps = 0;
    CHECK_EQUAL(with_larger_budgets(found, wanted).offline_updates, 200);
    CHECK_EQUAL(with_larger_budgets(wanted, found).offline_updates, 200);
}

TEST(a_run_of_other_settings_is_told_what_it_has_and_what_was_asked_for) {
    const Settings found = default_settings("gridworld", "wodtem", "small");
    Settings wanted = found;
    wanted.alpha = 0.5;
    try {
        require_same_settings(found, wanted, "f");
        CHECK(!"the same");
    } catch (const Error& error) {
        CHECK(std::string(error.what())
                  .starts_with("f belongs to a run with alpha = 0.75, but 0.5 was asked for; choose another folder"));
    }
}

TEST(an_update_has_at_most_a_million_steps) {
    Settings settings = default_settings("gridworld", "wodtem", "small");
    settings.batch_size = settings.context_length = 1000;
    check_together(settings);
    settings.batch_size = 1001;
    CHECK_FAILS("usage.setting", check_together(settings));
}

// The setting came later: a file of before does not have it, and one of after only where it is yes.
TEST(clipping_of_actions_is_a_setting_that_only_its_users_files_have) {
    Settings settings = default_settings("hopper-medium-v2", "wodtem", "small");
    const std::string text = settings_text(settings);
    CHECK(text.find("clip_actions") == std::string::npos && !settings_from_text(text, "f").clip_actions);
    set_from(settings, "clip_actions", "yes", "command line");
    CHECK(settings_text(settings).find("clip_actions = yes ") != std::string::npos);
    CHECK(settings_from_text(settings_text(settings), "f").clip_actions);
    CHECK(train_command(settings).find(" --clip-actions") != std::string::npos);
    CHECK_FAILS("run.other_settings", require_same_settings(settings_from_text(text, "f"), settings, "g"));
    Settings grid = default_settings("gridworld", "wodtem", "small");
    grid.clip_actions = true;
    CHECK_FAILS("usage.setting", check_together(grid));
}

TEST(a_data_set_is_looked_for_in_d4rls_folder_and_then_in_ours) {
    char name[] = "/tmp/wodtem-test-XXXXXX";
    const std::string folder = mkdtemp(name);
    const char* const before = std::getenv("D4RL_DATASET_DIR");
    const std::string kept = before ? before : "";
    setenv("D4RL_DATASET_DIR", folder.c_str(), 1);
    const PublishedDataSet& set = *find_published("maze2d-large-v1");
    CHECK_EQUAL(file_name(set), "maze2d-large-sparse-v1.hdf5");
    if (!std::filesystem::exists(std::string(own_folder) + "/" + file_name(set))) {
        CHECK_FAILS("dataset.missing", find_data_set(set));
        try {
            find_data_set(*find_published("ant-medium-v2"));
        } catch (const Error& error) {
            CHECK(std::string(error.what()).find("wodtem collect ant-medium-v2 (") != std::string::npos);
        }
    }
    write_file_atomic(folder + "/maze2d-large-sparse-v1.hdf5", "x");
    CHECK_EQUAL(find_data_set(set), folder + "/maze2d-large-sparse-v1.hdf5");
    before ? setenv("D4RL_DATASET_DIR", kept.c_str(), 1) : unsetenv("D4RL_DATASET_DIR");
    std::filesystem::remove_all(folder);
    CHECK(find_published("maze2d-huge-v1") == nullptr);
    for (const PublishedDataSet& one : published_data_sets) {
        CHECK(find_mujoco_task(one.id) != nullptr);
        CHECK_EQUAL(default_settings(one.id, "odt", "paper").task, one.id);
    }
}

TEST(any_name_of_a_data_set_is_read_back_and_its_checksum_alone_tells_data_apart) {
    Settings settings;
    constexpr const char* names =  // between bars
        "plain.hdf5|my set # 2.hdf5| a|a |a\t|a\nseed = 1 # x||#|\"|\"a\"|a\"b # c|\\|\\x41|\"\\x41\"|\x7f\x1b[31m|"
        "M\u00e4\u4e2d # .h5|\xff\xfe|a = b|a#b|none # ";
    for (const std::string& name : split(names, '|')) {
        settings.dataset = name;
        const std::string text = settings_text(settings);
        CHECK_EQUAL(settings_from_text(text, "f").dataset, name);
        CHECK(is_utf8(text) && std::ranges::count(text, '\n') == std::ranges::count(settings_text({}), '\n'));
        CHECK_EQUAL(settings_text(settings_from_text(text, "f")), text);
    }
    CHECK_EQUAL(quoted("my set.hdf5"), "my set.hdf5");  // as before
    CHECK_EQUAL(quoted("a\\b"), "a\\b");
    CHECK_EQUAL(quoted(" M\u00e4 # 2\n"), "\" M\u00e4 \\x23 2\\x0a\"");
    for (const char* earlier : {"\"", "\"a", "\"a\" b", "\"a\"b\"", "\"\\\"", "\"\\x4\"", "\"\\x4g\"", "\"\\y41\""})
        CHECK_EQUAL(unquoted(earlier), earlier);  // what earlier versions wrote for such names

    Settings renamed = settings;
    renamed.dataset = "another name";
    require_same_settings(settings, renamed, "f");
    renamed.dataset_sha256 = "0123";
    CHECK_FAILS("run.other_settings", require_same_settings(settings, renamed, "f"));
    renamed.dataset = settings.dataset;
    CHECK_FAILS("run.other_settings", require_same_settings(settings, renamed, "f"));
}
