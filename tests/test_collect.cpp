// test_collect.cpp: data/antmaze.hpp and data/collect.hpp against brute force, hand-computed cases, the engine and what
// D4RL's layout has. In order: the planner; the walker; antmaze's rows; training to a level; replay and medium sets.
#include <unistd.h>

#include <cstring>
#include <filesystem>
#include <string>
#include <vector>

#include "../data/collect.hpp"
#include "../data/info.hpp"
#include "test.hpp"

// ---------------------------------------------------------------------------------------------------------------------
// The planner

namespace {

// Distances to `goal` over cells that are no walls, by relaxing until nothing changes; walls are reached, not passed.
std::vector<int> brute_force_distances(const std::string& map, int columns, MazeCell goal) {
    std::string cells;
    for (const char c : map)
        if (c != '/') cells += c;
    std::vector<int> distance(cells.size(), 1 << 20);
    const size_t start = static_cast<size_t>(goal.row * columns + goal.column);
    distance[start] = 0;
    for (bool changed = true; changed;) {
        changed = false;
        for (size_t from = 0; from < cells.size(); ++from)
            for (size_t to = 0; to < cells.size(); ++to) {
                const int down = static_cast<int>(to) / columns - static_cast<int>(from) / columns,
                          right = static_cast<int>(to) % columns - static_cast<int>(from) % columns;
                if (std::abs(down) + std::abs(right) != 1 || (cells[from] == '1' && from != start)) continue;
                if (distance[from] + 1 >= distance[to]) continue;
                distance[to] = distance[from] + 1;
                changed = true;
            }
    }
    return distance;
}

}  // namespace

TEST(ant_plan_takes_a_shortest_way_from_every_cell) {
    for (const char* map : {ant_umaze_map, medium_map, large_map, "1111/1001/1011/1111/", "10101/10101/10101/"}) {
        const std::string text = map;
        const int columns = static_cast<int>(text.find('/'));
        for (size_t goal = 0; goal < text.size(); ++goal) {
            if (text[goal] == '/' || text[goal] == '1') continue;
            const MazeCell end = {static_cast<int>(goal) / (columns + 1), static_cast<int>(goal) % (columns + 1)};
            const MazePlan plan({map}, end);
            const std::vector<int> distance = brute_force_distances(text, columns, end);
            CHECK_EQUAL(plan.next.size(), distance.size());
            for (size_t i = 0; i < distance.size(); ++i) {
                const MazeCell next = plan.next[i];
                if (distance[i] == 1 << 20) CHECK(next.row == -1 && next.column == -1);
                if (distance[i] == 1 << 20 || distance[i] == 0) continue;
                CHECK(plan.grid.contains(next.row, next.column));
                CHECK_EQUAL(distance[plan.grid.number(next)], distance[i] - 1);
                CHECK_EQUAL(plan.distance[i], distance[i]);
                CHECK_EQUAL(std::abs(next.row - static_cast<int>(i) / columns) +
                                std::abs(next.column - static_cast<int>(i) % columns),
                            1);
            }
            const MazeCell at_end = plan.next[plan.grid.number(end)];
            CHECK(at_end.row == end.row && at_end.column == end.column);
        }
    }
}

TEST(ant_plan_breaks_ties_in_the_order_left_right_down_up) {
    // From the middle of an open room its corners are reached first from the left and the right neighbour.
    const MazePlan plan({"11111/10001/10001/10001/11111/"}, {2, 2});
    for (const int row : {1, 3})
        for (const int column : {1, 3}) {
            const MazeCell next = plan.next[plan.grid.number({row, column})];
            CHECK(next.row == 2 && next.column == column);
        }
}

TEST(ant_cells_begin_at_their_own_centre) {
    const auto is = [](double x, double y, int row, int column) {
        const MazeCell cell = ant_cell_of(x, y);
        return cell.row == row && cell.column == column;
    };
    CHECK(is(0, 0, 1, 1) && is(-1.9, -0.5, 1, 1) && is(3.99, 0, 1, 1) && is(4, 0, 1, 2) && is(8.5, 7.9, 2, 3));
    CHECK(is(0.5, 8.6, 3, 1));
    CHECK(ant_cell_centre({1, 1}) == (std::array<double, 2>{0, 0}));
    CHECK(ant_cell_centre({3, 2}) == (std::array<double, 2>{4, 8}));
}

#ifdef WODTEM_MUJOCO

namespace {

const MujocoTask& task_of(const char* name) { return *find_mujoco_task(name); }

Compute& one_thread() {
    static Compute compute(best_kernel(), 1);
    return compute;
}

// A folder of this process alone, removed at the end.
struct Scratch {
    std::filesystem::path path;
    explicit Scratch(const char* name)
        : path(std::filesystem::temp_directory_path() / ("wodtem-collect-" + std::to_string(getpid()) + "-" + name)) {
        std::filesystem::create_directories(path);
    }
    ~Scratch() { std::filesystem::remove_all(path); }
    std::string operator/(const std::string& name) const { return path / name; }
};

}  // namespace

TEST(ant_is_sent_to_the_next_cell_and_at_last_to_the_goal) {
    const std::array<double, 2> goal = {0.75, 8.5};  // in the cell (3, 1)
    const MazePlan plan({ant_umaze_map}, ant_cell_of(goal[0], goal[1]));
    // From the start to the cell (1, 2), whose centre is (4, 0); down the right side, (3, 3) at (8, 8).
    CHECK_CLOSE(heading_to_goal(plan, {0, 0}, goal, {0.25, 0.5}), std::atan2(0.5, 4.25), 1e-15);
    CHECK_CLOSE(heading_to_goal(plan, {8.5, 4.5}, goal, {0.25, 0.5}), std::atan2(4.0, -0.25), 1e-15);
    // The goal is in the next cell, or in this: straight to it.
    CHECK_CLOSE(heading_to_goal(plan, {4.5, 8.5}, goal, {0.25, 0.5}), std::acos(-1.0), 1e-15);
    CHECK_CLOSE(heading_to_goal(plan, {0.75, 9}, goal, {0.25, 0.5}), std::atan2(-0.5, 0.0), 1e-15);
    CHECK_CLOSE(heading_to_goal(plan, {40, 8.5}, goal, {0.25, 0.5}), std::acos(-1.0), 1e-15);  // off the map
}

// ---------------------------------------------------------------------------------------------------------------------
// The walker

TEST(walker_sees_the_world_turned_by_its_heading) {
    const Random random{test_seed(), Stream::data_set};
    for (uint64_t trial = 0; trial < 200; ++trial) {
        std::vector<double> o(29);
        for (uint32_t i = 0; i < 29; ++i) o[i] = static_cast<double>(random.normal(trial, i));
        mju_normalize4(&o[3]);
        const double heading = 10 * random.uniform(trial, 100) - 5, c = std::cos(heading), s = std::sin(heading);
        std::vector<float> seen(27);
        see_from(heading, o, seen.data());
        // Rotation matrices, which do not tell q from -q: the seen one is the turn back times the observed one.
        const double turn[9] = {c, s, 0, -s, c, 0, 0, 0, 1};
        double q[4], observed[9], expected[9], got[9];
        for (size_t i = 0; i < 4; ++i) q[i] = static_cast<double>(seen[1 + i]);
        mju_quat2Mat(observed, &o[3]);
        mju_mulMatMat(expected, turn, observed, 3, 3, 3);
        mju_quat2Mat(got, q);
        for (size_t i = 0; i < 9; ++i) CHECK_CLOSE(got[i], expected[i], 1e-6);
        CHECK(seen[1] >= 0);
        CHECK_CLOSE(seen[13], c * o[15] + s * o[16], 1e-6);
        CHECK_CLOSE(seen[14], -s * o[15] + c * o[16], 1e-6);
        for (size_t i = 0; i < 27; ++i)
            if (i == 0 || (i >= 5 && i != 13 && i != 14)) CHECK_EQUAL(seen[i], static_cast<float>(o[2 + i]));
        see_from(0, o, seen.data());
        for (size_t i = 0; i < 27; ++i)
            CHECK_EQUAL(seen[i], static_cast<float>(i >= 1 && i <= 4 && o[3] < 0 ? -o[2 + i] : o[2 + i]));
    }
}

TEST(walking_ant_is_paid_its_speed_in_the_commanded_direction) {
    WalkingAnt ant;
    const Random resets{test_seed(), Stream::environment}, random{test_seed(), Stream::data_set};
    std::vector<float> state(27), action(8);
    ant.reset(resets, 3, state.data());
    std::vector<double> headings = {ant.heading};
    for (uint32_t t = 0; t < 120; ++t) {
        for (uint32_t i = 0; i < 8; ++i) action[i] = static_cast<float>(2 * random.uniform(t, i) - 1);
        const double x = ant.body.data->qpos[0], y = ant.body.data->qpos[1], heading = ant.heading;
        CHECK(x > 90 && y > 90);  // no wall there
        const Step step = ant.step(action.data(), state.data());
        const double dx = ant.body.data->qpos[0] - x, dy = ant.body.data->qpos[1] - y;
        CHECK_CLOSE(step.reward, (dx * std::cos(heading) + dy * std::sin(heading)) / 0.1, 1e-9);
        if (ant.heading != heading) {
            CHECK_EQUAL((t + 1) % 50, 0u);
            headings.push_back(ant.heading);
        }
        std::vector<float> seen(27);
        see_from(ant.heading, ant.body.observation, seen.data());
        CHECK(seen == state);
    }
    CHECK_EQUAL(headings.size(), size_t{3});
    for (const double heading : headings) CHECK(heading >= 0 && heading < 6.2831854);

    const auto falls = [&](double z, std::array<double, 4> turn) {
        std::vector<double> qpos(ant.body.model->qpos0, ant.body.model->qpos0 + 15), qvel(14);
        qpos[0] = qpos[1] = 100, qpos[2] = z;
        std::copy(turn.begin(), turn.end(), qpos.begin() + 3);
        ant.body.start(qpos, qvel);
        const std::vector<float> none(8);
        return ant.step(none.data(), state.data()).terminated;
    };
    CHECK(!falls(0.75, {1, 0, 0, 0}) && falls(2, {1, 0, 0, 0}) && falls(0.75, {0, 1, 0, 0}));
    CHECK(!falls(0.75, {0.95, 0.3, 0, 0}) && falls(0.75, {0.6, 0.8, 0, 0}) && !falls(0.75, {0, 0, 0, 1}));
}

// ---------------------------------------------------------------------------------------------------------------------
// antmaze's rows

TEST(ant_maze_rewards_test_the_next_row_against_one_goal) {
    CollectedRows<float> set;
    set.observations.resize(29 * 5);
    set.timeouts.resize(5);
    const std::array<std::array<float, 2>, 5> places = {{{0, 0}, {3.5f, 4}, {3.51f, 4}, {4, 3.4f}, {4, 4}}};
    for (size_t row = 0; row < 5; ++row) std::copy_n(places[row].begin(), 2, &set.observations[29 * row]);
    set.timeouts[2] = 1;  // the next row is another episode's: tested all the same
    relabel(set, {4, 4}, false);
    CHECK(set.rewards == (std::vector<float>{1, 1, 0, 1, 0}));
    CHECK(set.numeric_terminals == set.rewards);
    relabel(set, {4, 4}, true);  // the first of a run alone
    CHECK(set.rewards == (std::vector<float>{1, 0, 0, 1, 0}));
    relabel(set, {40, 4}, false);
    CHECK(set.rewards == std::vector<float>(5));
}

TEST(every_row_of_an_ant_maze_set_is_what_it_is_defined_to_be) {
    sac::Network<float> walker(27, 16, 16, 0.5, test_seed(), 0);  // untrained: it moves somehow
    for (const char* name : {"antmaze-umaze", "antmaze-umaze-diverse"}) {
        const bool diverse = name != std::string("antmaze-umaze");
        MujocoTask task = task_of(name);
        task.max_episode_steps = 40;  // many episodes in a short test; 700 is the same code
        constexpr size_t steps = 1500;
        const CollectedRows<float> set = collect_ant_maze_set(task, steps, test_seed(), walker);
        CHECK(set.length() == steps && set.observations.size() == 29 * steps && set.actions.size() == 8 * steps);
        CHECK(set.goal.size() == 2 * steps && set.qpos.size() == 15 * steps && set.qvel.size() == 14 * steps);
        CHECK(set.rewards.size() == steps && set.numeric_terminals == set.rewards);
        MujocoEnvironment environment(task, Physics::d4rl);
        std::vector<float> state(29);
        std::vector<int> starts(5 * 5), goals(5 * 5);
        for (size_t t = 0; t < steps; ++t) {
            const float *o = &set.observations[29 * t], *goal = &set.goal[2 * t];
            // 41 rows: the script counts after its test. Nothing else ends an episode.
            CHECK_EQUAL(set.timeouts[t], t % 41 == 40 ? 1 : 0);
            for (size_t i = 0; i < 8; ++i) CHECK(std::fabs(set.actions[8 * t + i]) <= 1);
            if (t % 41 == 0) {
                environment.reset(Random{test_seed(), Stream::environment}, data_set_episodes + t / 41, state.data());
                // The body's own noise, up to 0.1, may lead back over the cell's edge.
                const MazeCell start = ant_cell_of(o[0] + 0.1, o[1] + 0.1), end = ant_cell_of(goal[0], goal[1]);
                ++starts[static_cast<size_t>(5 * start.row + start.column)];
                ++goals[static_cast<size_t>(5 * end.row + end.column)];
                if (!diverse) {
                    CHECK(std::equal(state.begin(), state.end(), o));
                    CHECK_CLOSE(goal[0], environment.goal[0], 1e-6);
                    CHECK_CLOSE(goal[1], environment.goal[1], 1e-6);
                }
            } else {
                CHECK(goal[0] == goal[-2] && goal[1] == goal[-1]);
                // infos/qpos and qvel are of after the step: the next row's observation.
                CHECK(std::equal(o, o + 15, &set.qpos[15 * (t - 1)]) &&
                      std::equal(o + 15, o + 29, &set.qvel[14 * (t - 1)]));
            }
            if (!diverse) {  // the recorded actions lead through the recorded observations
                CHECK(std::equal(state.begin(), state.end(), o));
                environment.step(&set.actions[8 * t], state.data());
            }
        }
        const auto cells = [](const std::vector<int>& counts) {
            std::string used;
            for (size_t i = 0; i < counts.size(); ++i)
                if (counts[i] > 0) used += std::to_string(i / 5) + std::to_string(i % 5) + " ";
            return used;
        };
        CHECK_EQUAL(cells(starts), diverse ? "11 12 13 23 32 33 " : "11 ");
        CHECK_EQUAL(cells(goals), diverse ? "11 12 13 23 31 32 33 " : "31 ");

        CollectedRows<float> less = collect_ant_maze_set(task, 500, test_seed(), walker);  // the beginning of more
        CHECK(std::equal(less.observations.begin(), less.observations.end(), set.observations.begin()));
        CHECK(std::equal(less.rewards.begin(), less.rewards.end() - 1, set.rewards.begin()));
        const CollectedRows<float> other = collect_ant_maze_set(task, 50, test_seed() + 1, walker);
        CHECK(!std::equal(other.observations.begin(), other.observations.end(), set.observations.begin()));
    }
}

// An action is the walker's mean action plus 0.2 times a normal number, clipped.
TEST(ant_maze_actions_are_the_walkers_plus_noise) {
    sac::Network<float> walker(27, 16, 16, 1e-6, test_seed(), 0);  // its actions are nearly 0
    const CollectedRows<float> set = collect_ant_maze_set(task_of("antmaze-umaze"), 1000, test_seed(), walker);
    Moments noise;
    for (const float a : set.actions) noise.add(a);
    const Random random{test_seed(), Stream::data_set};
    for (uint32_t i = 0; i < 701 * 8; ++i)  // of the first episode: step t, site j
        CHECK_CLOSE(set.actions[i], std::clamp(0.2f * random.normal(data_set_episodes, i / 8, i % 8), -1.0f, 1.0f),
                    1e-4);
    CHECK_CLOSE(noise.mean(), 0, 5 * 0.2 / std::sqrt(8000));
    CHECK_CLOSE(noise.deviation(), 0.2, 5 * 0.2 / std::sqrt(16000));
}

TEST(an_ant_maze_set_has_d4rls_layout_and_its_walker_arrives) {
    const Scratch scratch("antmaze");
    const std::string path = scratch / "set.hdf5";
    constexpr size_t steps = 4 * 701;
    collect_data_set_file("antmaze-umaze-v2", path, steps, test_seed(), "", 1, {});
    const Hdf5File file = open_hdf5(path);
    const std::pair<const char*, const char*> types[] = {
        {"observations", "float32"}, {"actions", "float32"},    {"rewards", "float32"},    {"terminals", "float32"},
        {"timeouts", "bool"},        {"infos/goal", "float32"}, {"infos/qpos", "float32"}, {"infos/qvel", "float32"}};
    for (const auto& [name, type] : types) CHECK(file.find(name) && file.find(name)->type == type);
    CHECK(!file.find("next_observations"));
    const Rows rows = read_rows(file);
    CHECK(rows.count == steps && rows.state_dim == 29 && rows.action_dim == 8);
    // Nine in ten episodes arrive, so of four hardly ever none does.
    CHECK(std::count(rows.rewards.begin(), rows.rewards.end(), 1.0f) > 0);
    const std::string other = scratch / "hopper.safetensors";
    sac::save_policy(other, embedded_policy("hopper-medium"));
    CHECK_FAILS("collect.policy", collect_data_set_file("antmaze-umaze-v2", path, 10, 0, other, 1, {}));
    CHECK_FAILS("collect.policy", embedded_policy("hopper-expert"));
}

// ---------------------------------------------------------------------------------------------------------------------
// Training to a level

namespace {

// Ends soon: any policy of hopper is near such a level.
Training small_training(const MujocoTask& task, size_t rows) {
    Training training = gym_training(task, test_seed(), rows);
    training.settings.hidden = 16;
    training.settings.batch = 8;
    training.settings.random_steps = 100;
    training.settings.steps_per_update = 2;
    training.evaluate_every = 40;
    training.episodes = 4;
    training.level = 20;
    training.tolerance = 10;
    return training;
}

// The bytes of the set and of its policy; `stop`: at which questions the run is told to stop.
std::string replay_bytes(const MujocoTask& task, const Training& training, size_t steps, std::vector<int> stops) {
    const Scratch scratch("replay");
    const std::string path = scratch / "set.hdf5", checkpoint = scratch / "checkpoint";
    const Origin origin{"test", training.settings.seed};
    stops.push_back(1 << 30);
    for (const int stop : stops) {
        int asked = 0;
        Watch watch;
        watch.stop = [&] { return ++asked > stop; };
        const auto make = [&] {
            collect_medium_replay(path, task, steps, origin, training, one_thread(), checkpoint, watch);
        };
        if (stop < 1 << 30) {
            CHECK_FAILS("collect.stopped", make());
            CHECK(std::filesystem::exists(checkpoint));
            CHECK_EQUAL(std::distance(std::filesystem::directory_iterator(scratch.path), {}), ptrdiff_t{1});
        } else {
            make();
        }
    }
    return read_file(path) + read_file(path + ".policy.safetensors");
}

}  // namespace

TEST(a_collected_replay_has_the_same_bytes_when_its_training_was_stopped) {
    const MujocoTask& task = task_of("hopper");
    Training training = small_training(task, 400);
    const std::string whole = replay_bytes(task, training, 400, {});
    CHECK(replay_bytes(task, training, 400, {7}) == whole);              // among random steps
    CHECK(replay_bytes(task, training, 400, {120, 20, 1, 1}) == whole);  // among updates, again and again
    training.settings.seed += 1;
    CHECK(replay_bytes(task, training, 400, {}) != whole);
}

TEST(training_ends_at_the_first_evaluation_near_its_level) {
    const MujocoTask& task = task_of("hopper");
    Training training = small_training(task, 400);
    const Scratch scratch("level");
    const auto train = [&](const char* name, int stop) {
        LiveTask environment(task);
        auto learner = std::make_unique<sac::Learner>(training.settings, environment.spec(), one_thread());
        Watch watch;
        int asked = 0;
        watch.stop = [&] { return ++asked > stop; };
        const Moments returns = train_to_level(*learner, environment, training, scratch / name, watch);
        CHECK(std::fabs(returns.mean() - training.level) <= training.tolerance * training.level);
        CHECK_EQUAL(returns.count, 4.0);
        CHECK_EQUAL(learner->progress.updates % 40, uint64_t{0});
        return learner;
    };
    CHECK_EQUAL(train("first", 1 << 30)->progress.updates, uint64_t{40});
    LiveTask far(task);  // a policy far above the level is not at it
    sac::Learner good(training.settings, far.spec(), one_thread());
    Training low = training;
    Moments returns;
    low.level = 0.01;
    CHECK(!is_at_level(good, far, low, returns));
    CHECK(returns.mean() > 1);
    training.tolerance = 1e-9;  // never
    CHECK_FAILS("collect.stopped", train("never", 500));
    training.tolerance = 10;  // a run that goes on from a checkpoint at an evaluation evaluates there
    LiveTask environment(task);
    sac::Learner at_evaluation(training.settings, environment.spec(), one_thread());
    while (at_evaluation.progress.updates < 80) at_evaluation.step(environment);
    sac::save_checkpoint(scratch / "at", at_evaluation, training.name);
    CHECK_EQUAL(train("at", 1 << 30)->progress.updates, uint64_t{80});
}

// The published sets: which level, how many rows; ours keep one episode more.
TEST(trainings_have_the_published_levels_and_sizes) {
    const struct {
        const char *task, *set;
        double level;
        size_t rows;
        uint64_t interval;  // steps for each update
        int episodes;       // of an evaluation: more where returns rise quickly
    } known[] = {{"hopper", "hopper-medium-replay-v2", 1422.06, 402000, 4, 40},
                 {"walker2d", "walker2d-medium-replay-v2", 2852.09, 302000, 2, 100},
                 {"halfcheetah", "halfcheetah-medium-replay-v2", 4770.33, 202000, 2, 40},
                 {"ant", "ant-medium-replay-v2", 3051.26, 302000, 2, 100}};
    for (const auto& [task, set, level, rows, interval, episodes] : known) {
        CHECK_EQUAL(find_published(set)->steps, rows);
        const Training training = gym_training(task_of(task), 5, rows);
        CHECK_CLOSE(training.level, level, 0.01);
        CHECK(training.settings.capacity == rows + 1000 && training.settings.seed == 5);
        CHECK_EQUAL(training.name, std::string(task) + "-medium");
        CHECK_EQUAL(training.settings.steps_per_update, interval);
        CHECK(training.episodes == episodes && training.tolerance == (episodes == 100 ? 0.04 : 0.05));
    }
    CHECK_CLOSE(normalised_score(task_of("ant"), medium_return(task_of("ant"))), 80.30, 0.005);
}

// Within a tenth, as the mean of a whole set; ten episodes add three standard errors.
TEST(shipped_policies_have_the_published_returns) {
    Tape<float> tape(one_thread());
    for (const char* name : {"hopper", "walker2d", "halfcheetah", "ant"}) {
        sac::Network<float> policy = embedded_policy(std::string(name) + "-medium");
        LiveTask environment(task_of(name));
        const Moments returns = sampled_returns(tape, policy, environment, test_seed(), data_set_episodes, 10);
        const double level = medium_return(task_of(name));
        CHECK_CLOSE(returns.mean(), level, 0.1 * level + 3 * returns.deviation() / std::sqrt(returns.count));
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// Replay sets

TEST(retraced_rows_are_those_of_the_buffer) {
    for (const char* name : {"hopper", "ant"}) {
        const MujocoTask& task = task_of(name);
        constexpr size_t steps = 300;
        sac::Settings settings;
        settings.seed = test_seed();
        settings.capacity = steps + 1000;
        settings.random_steps = 1u << 30;
        LiveTask environment(task);
        const size_t live = static_cast<size_t>(live_columns(task)), S = static_cast<size_t>(task.state_dim),
                     A = static_cast<size_t>(task.action_dim);
        sac::Learner learner(settings, environment.spec(), one_thread());
        learner.progress.episodes = 2;        // as if two had broken down at their first step
        for (const int more : {350, 1500}) {  // before the ring wraps, and after
            for (int i = 0; i < more; ++i) learner.interact(environment);
            const CollectedRows<double> set = retrace(learner, task, steps);
            CHECK_EQUAL(set.length(), steps);
            CHECK(set.observations.size() == S * steps && set.actions.size() == A * steps && set.log_probs.empty());
            for (size_t i = 0; i < steps; ++i) {
                const size_t row = learner.replay.recent(steps - i);
                const auto same = [](const double* x, const float* y, size_t n) {
                    return std::equal(x, x + n, y, [](double a, float b) { return static_cast<float>(a) == b; });
                };
                CHECK(same(&set.observations[S * i], learner.replay.row(row), live));
                CHECK(same(&set.next_observations[S * i], learner.replay.next_state(row), live));
                CHECK(same(&set.actions[A * i], learner.replay.action(row), A));
                CHECK_EQUAL(static_cast<float>(set.rewards[i]), learner.replay.reward(row));
                for (size_t j = live; j < S; ++j) CHECK_EQUAL(set.observations[S * i + j], 0.0);
                const size_t first = static_cast<size_t>(task.first_position), Q = set.qpos.size() / steps;
                CHECK(std::equal(&set.qpos[Q * i + first], &set.qpos[Q * (i + 1)], &set.observations[S * i]));
                const sac::End end = learner.replay.end(row);
                CHECK_EQUAL(set.terminals[i], end == sac::End::terminated ? 1 : 0);
                CHECK_EQUAL(set.timeouts[i], end == sac::End::cut || (i + 1 == steps && !set.terminals[i]) ? 1 : 0);
            }
        }
        learner.replay.rows[learner.replay.width() * learner.replay.recent(1) + live + A + 2] += 1;  // where it led
        CHECK_FAILS("collect.replay", retrace(learner, task, steps));
    }
}

TEST(a_replay_set_has_d4rls_layout) {
    const Scratch scratch("layout");
    const MujocoTask& task = task_of("hopper");
    const std::string path = scratch / "hopper_medium_replay-v2.hdf5";
    collect_medium_replay(path, task, 500, {"test", test_seed()}, small_training(task, 500), one_thread(),
                          scratch / "checkpoint", {});
    const Hdf5File file = open_hdf5(path);
    for (const char* name : {"observations", "next_observations", "actions", "rewards", "infos/qpos", "infos/qvel"}) {
        CHECK(file.find(name) && file.find(name)->shape[0] == 500);
        if (file.find(name)) CHECK_EQUAL(file.find(name)->type, "float64");
    }
    CHECK(file.find("metadata/algorithm") && file.find("metadata/iteration") &&
          !file.find("metadata/policy/fc0/weight"));
    CHECK(!file.find("infos/action_log_probs"));
    CHECK_EQUAL(file.read<float>(*file.find("metadata/iteration"))[0], 0.0f);  // 40 updates, counted in thousands
    const std::string info = printed([&] { print_data_set(path, "hopper-medium-replay-v2"); });
    const auto number_after = [&](const char* words) {
        return std::stod(info.substr(info.find(words, info.find("physics 2.2 ")) + std::strlen(words)));
    };
    CHECK(number_after(" taken again end ") < number_after(" at most "));
    const Rows rows = read_rows(file);
    const std::vector<Trajectory> trajectories = cut_trajectories(rows, task, path);
    const DataSetStatistics s = statistics_of(rows, trajectories);
    CHECK(s.left_out == 0 && s.jumps == 0 && s.repeated == 0);
    const TensorFile written = read_safetensors(path + ".policy.safetensors");  // after 100 random steps one in two
    CHECK_EQUAL(written.text("updates") + " " + written.text("steps"), "40 180");
    const sac::Network<float> policy = sac::policy_of(written);
    check_policy(policy, 11, 3);
    CHECK_FAILS("collect.policy", check_policy(policy, 17, 6));
}

TEST(a_medium_set_has_d4rls_layout_and_a_policy_of_all_columns) {
    const Scratch scratch("medium");
    const MujocoTask& task = task_of("ant");
    const std::string path = scratch / "ant_medium-v2.hdf5";
    const sac::Network<float> network(27, 256, 16, 0.1, test_seed(), 0);
    collect_medium(path, task, 1200, {"test", test_seed()}, network, [](size_t) {});
    CHECK_FAILS("collect.policy", collect_medium(path, task_of("hopper"), 10, {"", 0}, network, [](size_t) {}));
    const Hdf5File file = open_hdf5(path);
    const Rows rows = read_rows(file);
    CHECK(rows.count == 1200 && rows.state_dim == 111);
    for (const char* name : {"observations", "actions", "infos/action_log_probs", "metadata/policy/fc0/weight"})
        CHECK_EQUAL(file.find(name)->type, "float32");
    CHECK(file.find("metadata/policy/fc0/weight")->shape == (Shape{256, 111}));
    CHECK(file.find("metadata/policy/last_fc_log_std/weight")->shape == (Shape{8, 256}));
    // The stored network, given whole observations, says what the played one said of the actions taken.
    const std::vector<float> weights = file.read<float>(*file.find("metadata/policy/fc0/weight")),
                             log_probs = file.read<float>(*file.find("infos/action_log_probs"));
    CHECK_EQUAL(file.find("infos/action_log_probs")->shape.size(), size_t{1});
    for (size_t unit = 0; unit < 256; ++unit)
        for (size_t i = 0; i < 111; ++i)
            CHECK_EQUAL(weights[111 * unit + i], i < 27 ? network.parameters[0].value[27 * unit + i] : 0.0f);
    sac::Network<float> whole(111, 256, 16, 0.1, test_seed(), 0);
    whole.parameters = network.parameters;
    whole.parameters[0] = {"fc0.weight", {256, 111}, weights, std::vector<float>(weights.size())};
    Tape<float> tape(one_thread());
    Random normals{test_seed(), Stream::exploration};
    for (uint32_t t = 0; t < 20; ++t) {
        std::vector<float> noise(8);
        for (uint32_t i = 0; i < 8; ++i) noise[i] = normals.normal(data_set_episodes, t, i);
        const auto [action, log_prob] = sac::act(tape, whole, rows.observation(t), noise);
        CHECK_CLOSE(log_prob, log_probs[t], 1e-4);
        for (size_t i = 0; i < 8; ++i) CHECK_CLOSE(action[i], rows.actions[8 * t + i], 1e-5);
    }
    // A last step allowed has the timeout alone; here the policy falls now and then or runs into the limit.
    size_t length = 0;
    for (size_t t = 0; t < rows.count; ++t) {
        ++length;
        CHECK(!(rows.terminals[t] && rows.timeouts[t]));
        CHECK_EQUAL(rows.timeouts[t], length == 1000 ? 1 : 0);
        const bool ends = rows.terminals[t] || rows.timeouts[t];
        if (!ends && t + 1 < rows.count)
            CHECK(std::equal(rows.observation(t + 1), rows.observation(t + 1) + 111, &rows.next_observations[111 * t]));
        if (ends) length = 0;
    }
}

// Uniformly random actions let the hopper fall at some step; where that is the last step allowed, it is a timeout.
TEST(a_fall_at_the_last_step_allowed_is_a_timeout_alone) {
    MujocoTask task = *find_mujoco_task("hopper-medium-v2");
    const auto play_to_the_end = [&] {
        LiveTask<float> hopper(task);
        float state[11], action[3];
        hopper.reset({test_seed(), Stream::environment}, 0, state);
        const Random random{test_seed(), Stream::data_set};
        for (uint32_t t = 0;; ++t) {
            for (uint32_t i = 0; i < 3; ++i) action[i] = static_cast<float>(2 * random.uniform(t, i) - 1);
            if (hopper.step(action, state).terminated) return hopper.rows;
        }
    };
    const auto fallen = play_to_the_end();
    CHECK(fallen.terminals.back() == 1 && fallen.timeouts.back() == 0);
    task.max_episode_steps = static_cast<int>(fallen.rewards.size());
    const auto cut = play_to_the_end();
    CHECK_EQUAL(cut.rewards.size(), fallen.rewards.size());
    CHECK(cut.terminals.back() == 0 && cut.timeouts.back() == 1);
}

// ---------------------------------------------------------------------------------------------------------------------
// The body of `wodtem collect`

TEST(a_finished_training_removes_its_own_files_alone) {
    const Scratch scratch("folder");
    const std::string path = scratch / "set.hdf5", folder = path + ".training";
    const auto train = [&](bool stop) {
        train_in_folder(path, [&](const std::string& checkpoint) {
            write_file_atomic(checkpoint, "the state of a run");
            CHECK_FAILS("run.busy", train_in_folder(path, [](const std::string&) { CHECK(!"two at once"); }));
            if (stop) fail("collect.stopped", "as agreed");
        });
    };
    CHECK_FAILS("collect.stopped", train(true));
    CHECK_EQUAL(read_file(folder + "/checkpoint.safetensors"), "the state of a run");
    write_file_atomic(folder + "/checkpoint.safetensors.123.tmp", "half of a state");  // of a killed process
    train(false);
    CHECK(!std::filesystem::exists(folder));

    std::filesystem::create_directories(folder + "/notes");
    write_file_atomic(folder + "/notes/mine", "not wodtem's");
    train(false);
    CHECK_EQUAL(read_file(folder + "/notes/mine"), "not wodtem's");
    CHECK(!std::filesystem::exists(folder + "/checkpoint.safetensors"));

    write_file_atomic(scratch / "file", "");
    CHECK_FAILS("collect.folder", make_folder(scratch / "file/below", "collect.folder"));
}

TEST(a_collected_file_says_how_it_was_made_and_shows_its_progress) {
    const Scratch scratch("file");
    double share = 0;
    Watch watch;
    std::string latest;
    watch.show = [&](const char* phase, double done, const std::string& numbers) {
        CHECK_EQUAL(phase, std::string("collecting"));
        latest = numbers;
        CHECK(done >= share && done <= 1);
        share = done;
    };
    const auto collect = [&](const std::string& id, const std::string& name, const std::string& policy = "") {
        share = 0;
        collect_data_set_file(id, scratch / name, 10000, 7, policy, 1, watch);
        const Hdf5File file = open_hdf5(scratch / name);
        CHECK(file.find("metadata/made_by"));
        const std::string made_by = "wodtem collect " + id + " --steps 10000 --seed 7";
        CHECK(read_file(scratch / name).find(made_by) != std::string::npos);
        CHECK_EQUAL(read_rows(file).count, size_t{10000});
        CHECK(file.read<float>(*file.find("metadata/seed")) == (std::vector<float>{7}));
        CHECK_EQUAL(share, 1.0);
        CHECK_EQUAL(latest, "row 10000");
    };
    collect("maze2d-umaze-v1", "new/folder/maze.hdf5");
    collect("hopper-medium-v2", "hopper.hdf5");
    const std::string policy = scratch / "policy.safetensors";
    sac::save_policy(policy, sac::Network<float>(11, 16, 6, 0.1, test_seed(), 0));
    collect("hopper-medium-v2", "other.hdf5", policy);
    CHECK(read_file(scratch / "hopper.hdf5") != read_file(scratch / "other.hdf5"));
    CHECK_FAILS("collect.task", collect("lunar-lander-v2", "x.hdf5"));
    CHECK_FAILS("collect.policy", collect("antmaze-umaze-v2", "x.hdf5", policy));
}

// The path of the whole command to a training that is stopped at its first question.
TEST(collecting_a_replay_set_or_a_walker_trains_and_stops_when_asked) {
    const Scratch scratch("trains");
    Watch watch;
    watch.stop = [] { return true; };
    for (const char* id : {"hopper-medium-replay-v2", walker_name}) {
        const std::string path = scratch / id;
        CHECK_FAILS("collect.stopped", collect_data_set_file(id, path, 2000, 1, "", 1, watch));
        CHECK(std::filesystem::exists(path + ".training/checkpoint.safetensors") && !std::filesystem::exists(path));
    }
}

#endif  // WODTEM_MUJOCO
