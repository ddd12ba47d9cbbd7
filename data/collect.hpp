// collect.hpp: makes data sets of D4RL's kinds, in D4RL's layout: maze2d by its planner and controller (waypoints.hpp),
// antmaze by its planner and a walker (antmaze.hpp), and of the gym tasks medium-replay, the replay buffer of a soft
// actor-critic run (sac.hpp) up to the published return of the medium set, and medium, the actions of the policy with
// which such a run ended.
//
// In order: policies; training to a level; the families of data sets; the body of `wodtem collect`.
// Promises: a data set is a function of (task, steps, seed, policy, machine), however often its making was stopped; its
// metadata say how it was made, so that nobody takes it for D4RL's. Leaves out: expert and random sets.
#pragma once

#include <filesystem>

#include "antmaze.hpp"
#include "console.hpp"
#include "d4rl.hpp"
#include "rows.hpp"
#include "run_folder.hpp"
#include "sac.hpp"
#include "settings.hpp"
#include "waypoints.hpp"

// Shows the progress of a long command and asks whether to stop it.
struct Watch {
    // phase: "collecting" or "training"; share: of the work that is done, in [0, 1]; numbers: a short text.
    std::function<void(const char* phase, double share, const std::string& numbers)> show = [](auto&&...) {};
    std::function<bool()> stop = [] { return false; };
};

#ifdef WODTEM_MUJOCO

// ---------------------------------------------------------------------------------------------------------------------
// Policies.

WODTEM_EMBED(wodtem_hopper_medium, "data/policies/hopper-medium.safetensors")
WODTEM_EMBED(wodtem_walker2d_medium, "data/policies/walker2d-medium.safetensors")
WODTEM_EMBED(wodtem_halfcheetah_medium, "data/policies/halfcheetah-medium.safetensors")
WODTEM_EMBED(wodtem_ant_medium, "data/policies/ant-medium.safetensors")
WODTEM_EMBED(wodtem_antmaze_walker, "data/policies/antmaze-walker.safetensors")

// A policy that this program holds: "hopper-medium" and so on, or "antmaze-walker". Errors: collect.policy.
inline sac::Network<float> embedded_policy(const std::string& name) {
    const std::map<std::string, std::pair<const char*, const char*>> embedded = {
        // begin and end
        {"hopper-medium", {wodtem_hopper_medium, wodtem_hopper_medium_end}},
        {"walker2d-medium", {wodtem_walker2d_medium, wodtem_walker2d_medium_end}},
        {"halfcheetah-medium", {wodtem_halfcheetah_medium, wodtem_halfcheetah_medium_end}},
        {"ant-medium", {wodtem_ant_medium, wodtem_ant_medium_end}},
        {walker_name, {wodtem_antmaze_walker, wodtem_antmaze_walker_end}}};
    require(embedded.contains(name), "collect.policy", "this version holds no policy ", name,
            "; give one with --policy FILE");
    const auto [begin, end] = embedded.at(name);
    return sac::policy_of(parse_safetensors(std::string(begin, end), "the policy " + name));
}

// A policy must fit the task's states and actions. Errors: collect.policy.
inline void check_policy(const sac::Network<float>& policy, int inputs, int actions) {
    require(policy.inputs() == inputs && policy.outputs() == 2 * actions, "collect.policy", "the policy has ",
            policy.inputs(), " inputs and ", policy.outputs() / 2, " actions, expected ", inputs, " and ", actions,
            "; give this task's policy");
}

// ---------------------------------------------------------------------------------------------------------------------
// Training: a soft actor-critic run that ends at a level.

// How many entries of the observation a network sees, from the first on: ant's others (contact forces) are always 0.
inline int live_columns(const MujocoTask& task) { return task.rules == Rules::ant ? 27 : task.state_dim; }

// A gym task whose states are its live columns alone. While `recording` it keeps the rows of the present episode as
// D4RL's files have them; after an error the last row is not complete, and the episode must be dropped.
// T: see CollectedRows.
template <class T = float>
struct LiveTask : Environment {
    MujocoEnvironment body;
    bool recording = true;
    CollectedRows<T> rows = {};

    explicit LiveTask(const MujocoTask& task) : body(task, Physics::d4rl) {}

    EnvironmentSpec spec() const override {
        return {live_columns(*body.task), body.task->action_dim, 0, body.task->max_episode_steps};
    }
    void reset(const Random& random, uint64_t episode, float* state) override {
        rows = {};
        std::vector<float> whole_state(body.observation.size());
        body.reset(random, episode, whole_state.data());
        std::copy_n(whole_state.begin(), live_columns(*body.task), state);
    }
    Step step(const float* action, float* state) override {
        if (recording) {
            append_all(rows.observations, body.observation);
            append_all(rows.qpos, std::span(body.data->qpos, body.model->nq));
            append_all(rows.qvel, std::span(body.data->qvel, body.model->nv));
        }
        const Step result = body.advance(std::vector<double>(action, action + body.task->action_dim));
        std::copy_n(body.observation.begin(), live_columns(*body.task), state);
        if (!recording) return result;
        append_all(rows.next_observations, body.observation);
        append_all(rows.actions, std::span(action, body.task->action_dim));
        rows.rewards.push_back(static_cast<T>(result.reward));
        // At the last step allowed only the timeout is set, also if the agent fell there, as in D4RL.
        const bool timeout = body.steps >= body.task->max_episode_steps;
        rows.timeouts.push_back(timeout);
        rows.terminals.push_back(result.terminated && !timeout);
        return result;
    }
    std::unique_ptr<Environment> clone() const override { return std::make_unique<LiveTask>(*this); }
};

// A run ends at the first evaluation whose mean return is within `tolerance` times the level of the level.
struct Training {
    std::string name;  // of the policy
    sac::Settings settings;
    double level;  // return
    double tolerance = 0.05;
    uint64_t evaluate_every = 5000;  // updates
    int episodes = 40;               // of an evaluation, with sampled actions, as in a medium set
};

// Training for a gym task's medium policy and its replay set of `rows` rows. D4RL's runs made as many updates as steps;
// ours make fewer, because an update costs more than a step. The buffer holds one episode more than the set has rows,
// so that the episode of the first row is there from its beginning.
// departs from rlkit: a batch of 128 instead of 256, for half the time.
inline Training gym_training(const MujocoTask& task, uint32_t seed, size_t rows) {
    const uint64_t capacity = rows + task.max_episode_steps, interval = task.rules == Rules::hopper ? 4 : 2;
    // Returns of these two rise quickly past the level, and a lucky evaluation near it would end the run too early.
    const bool is_steep = task.rules == Rules::walker2d || task.rules == Rules::ant;
    return {.name = std::string(task.name) + "-medium",
            .settings = {.seed = seed, .batch = 128, .capacity = capacity, .steps_per_update = interval},
            .level = medium_return(task),
            .tolerance = is_steep ? 0.04 : 0.05,
            .episodes = is_steep ? 100 : 40};
}

// Training for antmaze's walker.
// departs from D4RL's policies: half their width, for a third of the time.
inline Training walker_training(uint32_t seed) {
    // 0.8 m/s over 500 steps is a return of 400.
    return {walker_name, {.seed = seed, .hidden = 128, .batch = 128, .steps_per_update = 2}, 400};
}

// Undiscounted returns of episodes with sampled actions. Episodes in which the simulation breaks down do not count.
inline Moments sampled_returns(Tape<float>& tape, sac::Network<float>& policy, Environment& environment, uint32_t seed,
                               uint64_t first_episode, int episodes) {
    Moments returns;
    for (int i = 0; i < episodes; ++i) {
        const Episode episode = sac::play_sampled(tape, policy, environment, seed, first_episode + i);
        if (episode.error.empty()) returns.add(episode.total_reward);
    }
    return returns;
}

constexpr uint64_t training_evaluations = uint64_t{1} << 40;  // the numbers of their episodes, the same at each
constexpr double checkpoint_interval = 60;                    // seconds

inline std::string fixed(double x, int digits) {
    char text[40];
    std::snprintf(text, sizeof text, "%.*f", digits, x);
    return text;
}

// Whether the learner's policy is at the level: a quarter of the episodes must come within four times the tolerance,
// then the whole number within the tolerance. `returns`: of the evaluation that decided.
inline bool is_at_level(sac::Learner& learner, Environment& environment, const Training& training, Moments& returns) {
    Tape<float> tape(learner.learning.compute);
    const auto is_near = [&](uint64_t first_episode, int episodes, double tolerance) {
        returns = sampled_returns(tape, learner.policy, environment, training.settings.seed, first_episode, episodes);
        return std::fabs(returns.mean() - training.level) <= tolerance * training.level;
    };
    return is_near(training_evaluations, (training.episodes + 3) / 4, 4 * training.tolerance) &&
           is_near(training_evaluations + 1000, training.episodes, training.tolerance);
}

// Trains until is_at_level() after a multiple of `evaluate_every` updates, and returns the returns found there. Begins
// from the checkpoint if there is one; saves one when `watch` stops it, every checkpoint_interval, and at the end.
// Errors: collect.stopped, and those of sac.hpp.
inline Moments train_to_level(sac::Learner& learner, Environment& environment, const Training& training,
                              const std::string& checkpoint, const Watch& watch) {
    const std::unique_ptr<Environment> evaluated = environment.clone();
    if (std::filesystem::exists(checkpoint)) {
        sac::load_checkpoint(checkpoint, learner, training.name);
        learner.resume(environment);
    }
    const sac::Progress& p = learner.progress;
    const uint64_t first_update = p.updates;
    const Clock::time_point began = Clock::now();
    Clock::time_point saved = began;
    Moments returns;
    double best = 0;                 // mean return so far; for display alone
    uint64_t latest_evaluation = 0;  // its update
    while (true) {
        // Whether an evaluation is due follows from the learner's state, so a resumed run evaluates as a whole one.
        if (p.updates > 0 && p.updates % training.evaluate_every == 0 && p.updates != latest_evaluation) {
            latest_evaluation = p.updates;
            if (is_at_level(learner, *evaluated, training, returns)) break;
            best = std::max(best, returns.mean());
        }
        learner.step(environment);
        const bool stop = watch.stop();
        if (p.steps % 1000 != 0 && !stop) continue;
        const double rate = static_cast<double>(p.updates - first_update) / std::max(1e-3, seconds_since(began));
        std::string numbers = "update " + std::to_string(p.updates) + ", step " + std::to_string(p.steps);
        numbers += ", " + fixed(rate, 0) + " updates a second";
        if (returns.count > 0) numbers += ", return " + fixed(returns.mean(), 0) + " of " + fixed(training.level, 0);
        watch.show("training", std::clamp(best / training.level, 0.0, 0.99), numbers);
        if (!stop && seconds_since(saved) <= checkpoint_interval) continue;
        sac::save_checkpoint(checkpoint, learner, training.name);
        saved = Clock::now();
        if (stop)
            fail("collect.stopped",
                 "stopped after update %s; everything is saved in %s, and the same command continues",
                 std::to_string(p.updates).c_str(), checkpoint.c_str());
    }
    sac::save_checkpoint(checkpoint, learner, training.name);
    return returns;
}

// Trains a policy, or goes on with its training, and writes it to `path`. Errors: those of train_to_level().
inline sac::Learner train_policy(Environment& environment, const Training& training, Compute& compute,
                                 const std::string& path, const std::string& checkpoint, const Watch& watch) {
    sac::Learner learner(training.settings, environment.spec(), compute);
    const Moments returns = train_to_level(learner, environment, training, checkpoint, watch);
    sac::save_policy(path, learner.policy,
                     {{"name", training.name},
                      {"physics", "d4rl"},
                      {"return", fixed(returns.mean(), 2)},
                      {"return_deviation", fixed(returns.deviation(), 2)},
                      {"seed", std::to_string(training.settings.seed)},
                      {"steps", std::to_string(learner.progress.steps)},
                      {"updates", std::to_string(learner.progress.updates)}});
    return learner;
}

// ---------------------------------------------------------------------------------------------------------------------
// The families of data sets.

// What a collected file says of itself.
struct Origin {
    std::string command;
    uint32_t seed;
};

// Writes the first `steps` rows; add(file) writes what a family has beside them. The arrays are those of D4RL's layout:
// eight for the mazes, terminals as booleans in maze2d and as numbers in antmaze; for the gym tasks see CollectedRows.
template <class T>
void write_set(const std::string& path, const CollectedRows<T>& rows, size_t steps, const Origin& origin,
               const std::function<void(Hdf5Writer&)>& add = {}) {
    Hdf5Writer file(path);
    write_rows(file, rows, steps);
    if (add) add(file);
    file.text("metadata/made_by", origin.command);
    file.text("metadata/note", "a stand-in made by wodtem, not D4RL's data");
    file.text("metadata/mujoco", mujoco_version());
    file.add("metadata/seed", {1}, std::array{static_cast<int32_t>(origin.seed)});
    file.close();
}

// D4RL's metadata/policy, for states of state_dim numbers; inputs that the policy does not have get weights of 0.
inline void write_policy(Hdf5Writer& file, sac::Network<float> policy, size_t state_dim) {
    file.text("metadata/policy/nonlinearity", "relu");
    file.text("metadata/policy/output_distribution", "tanh_gaussian");
    Parameter<float>& first = policy.parameters[0];
    const size_t seen = std::exchange(first.shape[1], state_dim);
    for (size_t unit = 0; unit < first.shape[0]; ++unit)
        first.value.insert(first.value.begin() + static_cast<ptrdiff_t>(unit * state_dim + seen), state_dim - seen, 0);
    sac::each_policy_tensor(policy.parameters, [&](std::string name, const Shape& shape, auto values) {
        std::replace(name.begin(), name.end(), '.', '/');
        file.add("metadata/policy/" + name, shape, values);
    });
}

// The first `steps` rows of whole episodes of sampled actions. An episode in which the simulation breaks down is left
// out. `progress` gets the number of rows after every episode. Errors: collect.policy.
inline void collect_medium(const std::string& path, const MujocoTask& task, size_t steps, const Origin& origin,
                           sac::Network<float> policy, const std::function<void(size_t)>& progress) {
    check_policy(policy, live_columns(task), task.action_dim);
    LiveTask environment(task);
    Compute compute(best_kernel(), 1);
    Tape<float> tape(compute);
    CollectedRows<float> set;
    for (uint64_t number = data_set_episodes; set.length() < steps; ++number) {
        std::vector<float> log_probs;
        const Episode episode = sac::play_sampled(tape, policy, environment, origin.seed, number, &log_probs);
        if (!episode.error.empty()) continue;
        environment.rows.log_probs = std::move(log_probs);
        set.append(environment.rows);
        progress(set.length());
    }
    write_set(path, set, steps, origin, [&](Hdf5Writer& file) {
        file.text("metadata/algorithm", "SAC");
        write_policy(file, policy, task.state_dim);
    });
}

// The last `steps` rows of a run's replay, which itself holds single precision, neither qpos nor qvel, and live columns
// alone. An episode is a function of its number and its actions, so playing it again yields the rest.
// Errors: collect.replay.
inline CollectedRows<double> retrace(const sac::Learner& learner, const MujocoTask& task, size_t steps) {
    const sac::Replay& replay = learner.replay;
    const auto episode_of = [&](uint64_t back) { return replay.episode(replay.recent(back)); };
    LiveTask<double> environment(task);
    CollectedRows<double>& rows = environment.rows;
    CollectedRows<double> set;
    std::vector<float> state(replay.state_dim);
    uint64_t first = steps;  // rows back to the beginning of the first row's episode
    while (first < replay.size() && episode_of(first + 1) == episode_of(first)) ++first;
    for (uint64_t back = first; back > 0; --back) {
        const size_t row = replay.recent(back);
        if (back == first || episode_of(back) != episode_of(back + 1))
            environment.reset({learner.settings.seed, Stream::environment}, episode_of(back), state.data());
        environment.recording = back <= steps;
        environment.step(replay.action(row), state.data());
        require(std::equal(state.begin(), state.end(), replay.next_state(row)), "collect.replay", "episode ",
                episode_of(back), " went another way when it was played again");
        if (back > 1 && episode_of(back) == episode_of(back - 1)) continue;
        // Cut by a breakdown of the simulation, or by the end of the run: a timeout, as at the end of D4RL's blocks.
        if (rows.terminals.back() == 0) rows.timeouts.back() = 1;
        set.append(rows);
    }
    return set;
}

// Trains, or continues from the checkpoint, and writes the replay to PATH and the policy to PATH.policy.safetensors. If
// the level is reached before the replay has `steps` rows, the final policy makes the rest.
// Errors: collect.stopped, collect.replay.
inline void collect_medium_replay(const std::string& path, const MujocoTask& task, size_t steps, const Origin& origin,
                                  const Training& training, Compute& compute, const std::string& checkpoint,
                                  const Watch& watch) {
    LiveTask environment(task);
    environment.recording = false;
    sac::Learner learner =
        train_policy(environment, training, compute, path + ".policy.safetensors", checkpoint, watch);
    while (learner.replay.size() < steps) learner.interact(environment);
    write_set(path, retrace(learner, task, steps), steps, origin, [&](Hdf5Writer& file) {
        file.text("metadata/algorithm", "SAC");
        // D4RL's number of the checkpoint, which counts rlkit's epochs of 1000 updates.
        file.add("metadata/iteration", {1}, std::array{static_cast<int32_t>(learner.progress.updates / 1000)});
    });
}

// ---------------------------------------------------------------------------------------------------------------------
// The body of `wodtem collect`.

// Calls train(checkpoint) with a path in the folder PATH.training, which is locked meanwhile. Once it has returned, the
// checkpoint is removed, and the folder too unless it holds other files. After an error all stays, to continue from.
void train_in_folder(const std::string& path, auto&& train) {
    const std::string folder = path + ".training", checkpoint = folder + "/checkpoint.safetensors";
    make_folder(folder, "collect.folder");
    const FolderLock lock(folder);
    remove_temporaries(folder);
    stop_on_signals();
    train(checkpoint);
    std::error_code ignored;
    std::filesystem::remove(checkpoint, ignored);
    std::filesystem::remove(folder, ignored);
}

// Writes to `path` a stand-in of `steps` rows for the published data set `id`, or trains the policy that walks through
// antmaze where `id` is walker_name, which ignores `steps`. policy_path: a file with the policy that acts; empty: the
// embedded one. `threads`: of training.
// Errors: collect.*, run.busy, and those of the files.
inline void collect_data_set_file(const std::string& id, const std::string& path, size_t steps, uint32_t seed,
                                  const std::string& policy_path, int threads, const Watch& watch) {
    const Origin origin{
        "wodtem collect " + id + " --steps " + std::to_string(steps) + " --seed " + std::to_string(seed), seed};
    const MujocoTask* task = find_mujoco_task(id);
    require(task || id == walker_name, "collect.task", "no task of this program has data sets named ", id);
    const auto policy = [&](const std::string& name) {
        return policy_path.empty() ? embedded_policy(name) : sac::policy_of(read_safetensors(policy_path));
    };
    const auto show = [&](size_t rows) {
        const size_t done = std::min(rows, steps);
        watch.show("collecting", static_cast<double>(done) / static_cast<double>(steps), "row " + std::to_string(done));
    };
    if (const auto folder = std::filesystem::path(path).parent_path(); !folder.empty())
        make_folder(folder, "collect.folder");
    if (id == walker_name || id.find("-medium-replay") != std::string::npos) {
        train_in_folder(path, [&](const std::string& checkpoint) {
            Compute compute(best_kernel(), threads);
            if (id != walker_name)
                return collect_medium_replay(path, *task, steps, origin, gym_training(*task, seed, steps), compute,
                                             checkpoint, watch);
            WalkingAnt environment;
            train_policy(environment, walker_training(seed), compute, path, checkpoint, watch);
        });
    } else if (task->rules == Rules::maze2d) {
        write_set(path, collect_maze_data_set(*task, steps, seed, show), steps, origin);
    } else if (task->rules == Rules::antmaze) {
        sac::Network<float> walker = policy(walker_name);
        check_policy(walker, walking_ant_state, task->action_dim);
        write_set(path, collect_ant_maze_set(*task, steps, seed, walker, show), steps, origin);
    } else {
        collect_medium(path, *task, steps, origin, policy(std::string(task->name) + "-medium"), show);
    }
}

#else

inline void collect_data_set_file(const std::string&, const std::string& path, size_t, uint32_t, const std::string&,
                                  int, const Watch&) {
    fail("mujoco.absent", "%s needs MuJoCo 2.2, which was not there when this program was built; %s", path.c_str(),
         mujoco_advice);
}

#endif  // WODTEM_MUJOCO

// The help of collect: every data set, its rows, and the time that its making takes.
inline std::string collect_help() {
    std::string text = "\nID, rows, and how long it takes on one core:\n";
    char line[200];
    for (const PublishedDataSet& set : published_data_sets) {
        if (set.steps == 0) continue;
        std::snprintf(line, sizeof line, "  %-30s %8zu  %s\n", set.id, set.steps, set.collected_in);
        text += line;
    }
    std::snprintf(line, sizeof line, "  %-30s %8s  the policy of the antmaze sets, trained anew; 60,000 updates\n",
                  walker_name, "");
    return text + line + "A training that was stopped goes on with the same command.\n";
}

// The command `collect`. out: "" for D4RL's file name in runs/datasets; steps: 0 for as many rows as D4RL's.
// Errors: usage.task names the nearest data set; those of require_other_file() and collect_data_set_file().
inline void collect(const std::string& id, const std::string& out, int64_t steps, int64_t seed,
                    const std::string& policy, int threads) {
    const PublishedDataSet* set = find_published(id);
    const bool walker = id == walker_name;
    if ((!set || set->steps == 0) && !walker) {
        std::vector<std::string> names = {walker_name};
        for (const PublishedDataSet& one : published_data_sets)
            if (one.steps > 0) names.push_back(one.id);
        fail("usage.task", "collect makes stand-ins for the paper's data sets, and \"%s\" is none%s",
             excerpt(id).c_str(), nearest_hint(id, names).c_str());
    }
    require(!walker || steps == 0, "usage.option", "collect ", id,
            " trains a policy and makes no rows; leave --steps out");
    const bool planned = id.starts_with("maze2d"), trained = walker || id.find("-medium-replay") != std::string::npos;
    require(policy.empty() || !(planned || trained), "usage.option", "no given policy acts in ", id, ", which ",
            planned ? "a planner and a controller make" : "is made by training one", "; leave --policy out");
    if (steps == 0 && set) steps = static_cast<int64_t>(set->steps);
    const std::string name = walker ? id + ".safetensors" : file_name(*set);
    const std::string path = out.empty() ? std::string(own_folder) + "/" + name : out;
    require_other_file(path, policy);  // now, not after hours of training
    Console console{.label = id};
    const Watch watch{[&](const std::string& phase, double share, const std::string& text) {
                          console.show(phase, share, 0, [&] { return text; });
                      },
                      [] { return stop_requested != 0; }};
    collect_data_set_file(id, path, static_cast<size_t>(steps), static_cast<uint32_t>(seed), policy, threads, watch);
    if (walker)
        std::printf("%s: the policy; wodtem collect antmaze-umaze --policy %s\n", path.c_str(), path.c_str());
    else
        std::printf("%s: %lld steps; see: wodtem info %s\n", path.c_str(), static_cast<long long>(steps), path.c_str());
}
