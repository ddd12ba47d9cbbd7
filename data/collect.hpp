// collect.hpp: makes data sets of D4RL's kinds, in D4RL's layout: maze2d by its planner and controller (waypoints.hpp),
// antmaze by its planner and a walker (antmaze.hpp), and of the gym tasks medium-replay, the replay buffer of a soft
// actor-critic run (sac.hpp) up to the published return of the medium set, and medium, actions of the policy it ended
// with.
// Promises: a data set is a function of (task, steps, seed, policy, machine), however often its making was stopped; its
// metadata say how it was made, so that nobody takes it for D4RL's. Leaves out: expert and random sets.
#pragma once

#include <chrono>
#include <functional>
#include <string>
#include <vector>

#include "antmaze.hpp"
#include "d4rl.hpp"
#include "sac.hpp"
#include "waypoints.hpp"

#ifdef WODTEM_MUJOCO

// ---------------------------------------------------------------------------------------------------------------------
// Policies.

// A file's bytes as they were when this was compiled, and where they end.
#define WODTEM_EMBED(name, path)                                                                         \
    asm(".pushsection .rodata\n" #name ": .incbin \"" path "\"\n" #name "_end: .byte 0\n.popsection\n"); \
    extern "C" const char name[], name##_end[];
WODTEM_EMBED(wodtem_hopper_medium, "data/policies/hopper-medium.safetensors")
WODTEM_EMBED(wodtem_walker2d_medium, "data/policies/walker2d-medium.safetensors")
WODTEM_EMBED(wodtem_halfcheetah_medium, "data/policies/halfcheetah-medium.safetensors")
WODTEM_EMBED(wodtem_ant_medium, "data/policies/ant-medium.safetensors")
WODTEM_EMBED(wodtem_antmaze_walker, "data/policies/antmaze-walker.safetensors")
#undef WODTEM_EMBED

// A policy that this program holds: "hopper-medium" and so on, or "antmaze-walker". Errors: collect.policy.
inline sac::SavedPolicy embedded_policy(const std::string& name) {
    struct Embedded {
        const char *name, *begin, *end;
    };
    for (const Embedded& one : {Embedded{"hopper-medium", wodtem_hopper_medium, wodtem_hopper_medium_end},
                                {"walker2d-medium", wodtem_walker2d_medium, wodtem_walker2d_medium_end},
                                {"halfcheetah-medium", wodtem_halfcheetah_medium, wodtem_halfcheetah_medium_end},
                                {"ant-medium", wodtem_ant_medium, wodtem_ant_medium_end},
                                {walker_name, wodtem_antmaze_walker, wodtem_antmaze_walker_end}})
        if (name == one.name)
            return sac::policy_of(parse_safetensors(std::string(one.begin, one.end), "the policy " + name));
    fail("collect.policy", "this version holds no policy %s; give one with --policy FILE", name.c_str());
}

// Errors: collect.policy.
inline void check_policy(const sac::SavedPolicy& policy, int inputs, int actions) {
    if (policy.network.inputs() != inputs || policy.network.outputs() != 2 * actions)
        fail("collect.policy", "the policy sees %d numbers and gives %d actions, not %d and %d: is it another task's?",
             policy.network.inputs(), policy.network.outputs() / 2, inputs, actions);
}

// ---------------------------------------------------------------------------------------------------------------------
// Training: a soft actor-critic run that ends at a level.

// Of the observation, from the first on: the others are always 0 (ant's contact forces), and no network sees them.
inline int live_columns(const MujocoTask& task) { return task.rules == Rules::ant ? 27 : task.state_dim; }

// A gym task with its live columns alone.
struct LiveTask {
    MujocoEnvironment body;
    std::vector<float> all;

    explicit LiveTask(const MujocoTask& task) : body(task, Physics::d4rl), all(static_cast<size_t>(task.state_dim)) {}
    EnvironmentSpec spec() const {
        EnvironmentSpec spec = body.spec();
        spec.state_dim = live_columns(*body.task);
        return spec;
    }
    void reset(const Random& random, uint64_t episode, float* state) {
        body.reset(random, episode, all.data());
        std::copy_n(all.begin(), live_columns(*body.task), state);
    }
    Step step(const float* action, float* state) {
        const Step result = body.step(action, all.data());
        std::copy_n(all.begin(), live_columns(*body.task), state);
        return result;
    }
};

// A run ends at the first evaluation whose mean return is `tolerance` times the level from it at most.
struct Training {
    std::string name;  // of the policy
    sac::Settings settings;
    double level;  // return
    double tolerance = 0.05;
    uint64_t evaluate_every = 5000;  // updates
    int episodes = 40;               // of an evaluation, with sampled actions, as in a medium set
    int threads = 1;                 // of the learner; what it learns does not depend on it
};

// D4RL's runs made as many updates as steps; ours make fewer updates, which cost more than steps. The buffer keeps an
// episode more than the set has rows, so that the first row's episode is there from its beginning.
// departs from rlkit: a batch of 128 instead of 256, for half the time.
inline Training gym_training(const MujocoTask& task, uint32_t seed, size_t rows) {
    Training training{std::string(task.name) + "-medium", {}, medium_return(task)};
    training.settings.seed = seed;
    training.settings.batch = 128;
    training.settings.capacity = rows + static_cast<uint64_t>(task.max_episode_steps);
    training.settings.steps_per_update = task.rules == Rules::hopper ? 4 : 2;
    // These two climb past the level: of the first evaluations that come near it, a lucky one would end the run early.
    if (task.rules == Rules::walker2d || task.rules == Rules::ant) training.tolerance = 0.04, training.episodes = 100;
    return training;
}

// departs from D4RL's policies: half their width, for a third of the time.
inline Training walker_training(uint32_t seed) {
    Training training{walker_name, {}, 400};  // 0.8 m/s over 500 steps
    training.settings.seed = seed;
    training.settings.batch = 128;
    training.settings.hidden = 128;
    training.settings.steps_per_update = 2;
    return training;
}

// Whoever watches a long command: told how far it is, and asked whether to stop.
struct Watch {
    std::function<void(double share, const std::string& numbers)> show = [](double, const std::string&) {};
    std::function<bool()> stop = [] { return false; };
    double checkpoint_every = 60;  // seconds
};

inline Moments sampled_returns(Tape<float>& tape, sac::Network<float>& policy, auto& environment, uint32_t seed,
                               uint64_t first_episode, int episodes) {
    Moments returns;
    for (uint64_t i = 0; i < static_cast<uint64_t>(episodes); ++i) {
        const sac::Episode episode = sac::play(tape, policy, environment, seed, first_episode + i, true, [] {});
        if (!episode.spoiled) returns.add(episode.total);
    }
    return returns;
}

constexpr uint64_t training_evaluations = uint64_t{1} << 40;  // the numbers of their episodes, each time the same

// Evaluates the policy after every `evaluate_every` updates, at first with a quarter of the episodes; the whole number
// decides where that is within four times the tolerance. Begins from the checkpoint if there is one; saves one when it
// is asked to stop, from time to time, and at the end. Errors: collect.stopped, and those of sac.hpp.
template <class Environment>
Moments train_to_level(sac::Learner& learner, Environment& environment, const Training& training,
                       const std::string& checkpoint, const Watch& watch) {
    using Clock = std::chrono::steady_clock;
    Environment other = environment;  // for evaluations
    Tape<float> tape(learner.learning.compute);
    if (std::filesystem::exists(checkpoint)) {
        sac::load_checkpoint(checkpoint, learner, training.name);
        learner.resume(environment);
    }
    const sac::Progress& p = learner.progress;
    const auto near = [&](const Moments& returns, double tolerance) {
        return std::fabs(returns.mean() - training.level) <= tolerance * training.level;
    };
    Moments last;
    double best = 0;  // for the eye alone
    const auto began = Clock::now();
    auto saved = began;
    const uint64_t first_update = p.updates;
    const auto seconds_since = [](Clock::time_point then) {
        return std::chrono::duration<double>(Clock::now() - then).count();
    };
    const auto save = [&] { sac::save_checkpoint(checkpoint, learner, training.name), saved = Clock::now(); };
    for (uint64_t evaluated = 0;;) {
        // Whether it is time follows from the learner's state, so a resumed run evaluates where a whole one did.
        if (p.updates > 0 && p.updates % training.evaluate_every == 0 && p.updates != evaluated) {
            evaluated = p.updates;
            const uint32_t seed = training.settings.seed;
            last =
                sampled_returns(tape, learner.policy, other, seed, training_evaluations, (training.episodes + 3) / 4);
            best = std::max(best, last.mean());
            if (near(last, 4 * training.tolerance)) {
                last =
                    sampled_returns(tape, learner.policy, other, seed, training_evaluations + 1000, training.episodes);
                if (near(last, training.tolerance)) break;
            }
        }
        learner.step(environment);
        if (p.steps % 1000 != 0 && !watch.stop()) continue;
        char numbers[160];
        int used = std::snprintf(numbers, sizeof numbers, " upd %llu, step %llu, %.0f/s",
                                 static_cast<unsigned long long>(p.updates), static_cast<unsigned long long>(p.steps),
                                 static_cast<double>(p.updates - first_update) / std::max(1e-3, seconds_since(began)));
        if (last.count > 0)
            std::snprintf(numbers + used, sizeof numbers - static_cast<size_t>(used), ", ret %.0f of %.0f", last.mean(),
                          training.level);
        watch.show(std::clamp(best / training.level, 0.0, 0.99), numbers);
        if (watch.stop()) {
            save();
            fail("collect.stopped",
                 "stopped after update %llu; everything is saved in %s, and the same command continues",
                 static_cast<unsigned long long>(p.updates), checkpoint.c_str());
        }
        if (seconds_since(saved) > watch.checkpoint_every) save();
    }
    save();
    return last;
}

inline void save_trained_policy(const std::string& path, const sac::Learner& learner, const Training& training,
                                const Moments& returns) {
    const auto number = [](double x) {
        char text[40];
        std::snprintf(text, sizeof text, "%.2f", x);
        return std::string(text);
    };
    sac::save_policy(path, {learner.policy,
                            {{"name", training.name},
                             {"physics", "d4rl"},
                             {"return", number(returns.mean())},
                             {"return_deviation", number(returns.deviation())},
                             {"seed", std::to_string(training.settings.seed)},
                             {"steps", std::to_string(learner.progress.steps)},
                             {"updates", std::to_string(learner.progress.updates)}}});
}

// ---------------------------------------------------------------------------------------------------------------------
// Layouts.

// What a collected file says of itself.
struct Origin {
    std::string command;
    uint32_t seed;
};

inline void write_origin(Hdf5Writer& file, const Origin& origin) {
    file.text("metadata/made_by", origin.command);
    file.text("metadata/note", "a stand-in made by wodtem, not D4RL's data");
    file.text("metadata/mujoco", mujoco_version());
    file.add("metadata/seed", {1}, std::array{static_cast<int32_t>(origin.seed)});
}

inline std::vector<uint8_t> flags_of(const std::vector<float>& values) { return {values.begin(), values.end()}; }

template <class To, class From>
void append_all(std::vector<To>& to, const From& from) {
    for (const auto x : from) to.push_back(static_cast<To>(x));
}

// A gym task's rows, T: float in the medium sets, double in the replay sets, as D4RL has them.
template <class T>
struct GymSet {
    std::vector<T> observations, next_observations;  // [N, S]
    std::vector<T> actions, rewards;                 // [N, A], [N]
    std::vector<T> log_probs;                        // [N] of the actions; empty in replay sets
    std::vector<T> qpos, qvel;                       // [N, Q], [N, V], before the step
    std::vector<uint8_t> terminals, timeouts;        // [N]

    size_t length() const { return rewards.size(); }

    void append(const GymSet& more) {
        append_all(observations, more.observations), append_all(next_observations, more.next_observations);
        append_all(actions, more.actions), append_all(rewards, more.rewards);
        append_all(log_probs, more.log_probs);
        append_all(qpos, more.qpos), append_all(qvel, more.qvel);
        append_all(terminals, more.terminals), append_all(timeouts, more.timeouts);
    }
    // What is so before a step.
    void before(const MujocoEnvironment& environment) {
        append_all(observations, environment.observation);
        append_all(qpos, std::span(environment.data->qpos, static_cast<size_t>(environment.model->nq)));
        append_all(qvel, std::span(environment.data->qvel, static_cast<size_t>(environment.model->nv)));
    }
    // Where it led. At the last step allowed only the timeout is set, also if the agent fell on it, as in D4RL.
    void after(const MujocoEnvironment& environment, std::span<const float> action, const Step& step) {
        append_all(next_observations, environment.observation);
        append_all(actions, action);
        rewards.push_back(static_cast<T>(step.reward));
        timeouts.push_back(environment.steps >= environment.task->max_episode_steps);
        terminals.push_back(step.terminated && timeouts.back() == 0);
    }
};

// The first `steps` rows.
template <class T>
void write_gym_set(Hdf5Writer& file, const GymSet<T>& set, size_t steps) {
    const auto add = [&](const char* name, const auto& values, bool table) {
        const size_t width = values.size() / set.length();
        file.add(name, table ? Shape{steps, width} : Shape{steps}, std::span(values).first(steps * width));
    };
    add("observations", set.observations, true);
    add("next_observations", set.next_observations, true);
    add("actions", set.actions, true);
    add("rewards", set.rewards, false);
    add("terminals", set.terminals, false);
    add("timeouts", set.timeouts, false);
    if (!set.log_probs.empty()) add("infos/action_log_probs", set.log_probs, false);
    add("infos/qpos", set.qpos, true);
    add("infos/qvel", set.qvel, true);
    file.text("metadata/algorithm", "SAC");
}

// ---------------------------------------------------------------------------------------------------------------------
// The families.

// D4RL's layout of maze2d: eight data sets of N rows, here with the flags as booleans.
inline void collect_maze2d(const std::string& path, const MujocoTask& task, size_t steps, const Origin& origin,
                           const std::function<void(size_t)>& progress) {
    const MazeDataSet set = collect_maze_data_set(task, steps, origin.seed, progress);
    Hdf5Writer file(path);
    file.add("observations", {steps, 4}, set.observations);
    file.add("actions", {steps, 2}, set.actions);
    file.add("rewards", {steps}, set.rewards);
    file.add("terminals", {steps}, flags_of(set.terminals));
    file.add("timeouts", {steps}, flags_of(set.timeouts));
    file.add("infos/goal", {steps, 2}, set.goal);
    file.add("infos/qpos", {steps, 2}, set.qpos);
    file.add("infos/qvel", {steps, 2}, set.qvel);
    write_origin(file, origin);
    file.close();
}

// D4RL's layout of antmaze: the same eight names. Errors: collect.policy.
inline void collect_antmaze(const std::string& path, const MujocoTask& task, size_t steps, const Origin& origin,
                            sac::SavedPolicy walker, const std::function<void(size_t)>& progress) {
    check_policy(walker, walking_ant_state, task.action_dim);
    const AntMazeSet set = collect_ant_maze_set(task, steps, origin.seed, walker.network, progress);
    Hdf5Writer file(path);
    file.add("observations", {steps, 29}, set.observations);
    file.add("actions", {steps, 8}, set.actions);
    file.add("rewards", {steps}, set.rewards);
    file.add("terminals", {steps}, set.terminals);
    file.add("timeouts", {steps}, set.timeouts);
    file.add("infos/goal", {steps, 2}, set.goal);
    file.add("infos/qpos", {steps, 15}, set.qpos);
    file.add("infos/qvel", {steps, 14}, set.qvel);
    write_origin(file, origin);
    file.close();
}

// D4RL's metadata/policy; a policy that does not see the last columns has zeros for their weights.
inline void write_policy(Hdf5Writer& file, const sac::SavedPolicy& policy, size_t state_dim) {
    file.text("metadata/policy/nonlinearity", "relu");
    file.text("metadata/policy/output_distribution", "tanh_gaussian");
    const auto add = [&](std::string name, Shape shape, std::span<const float> values) {
        std::vector<float> widened;
        if (name == "fc0.weight") {
            const size_t seen = shape[1];
            widened.resize(shape[0] * state_dim);
            for (size_t unit = 0; unit < shape[0]; ++unit)
                std::copy_n(&values[unit * seen], seen, &widened[unit * state_dim]);
            shape[1] = state_dim;
            values = widened;
        }
        std::replace(name.begin(), name.end(), '.', '/');
        file.add("metadata/policy/" + name, shape, values);
    };
    sac::each_policy_tensor(policy.network.parameters, add);
}

// The first `steps` rows of whole episodes of sampled actions. An episode that the engine spoils is left out.
// Errors: collect.policy.
inline void collect_medium(const std::string& path, const MujocoTask& task, size_t steps, const Origin& origin,
                           sac::SavedPolicy policy, const std::function<void(size_t)>& progress) {
    check_policy(policy, live_columns(task), task.action_dim);
    LiveTask environment(task);
    const MujocoEnvironment& body = environment.body;
    Compute compute(best_kernel(), 1);
    Tape<float> tape(compute);
    GymSet<float> set;
    for (uint64_t number = data_set_episodes; set.length() < steps; ++number) {
        GymSet<float> rows;
        const sac::Episode episode = sac::play(
            tape, policy.network, environment, origin.seed, number, true, [&] { rows.before(body); },
            [&](const std::vector<float>& action, const Step& step) { rows.after(body, action, step); });
        if (episode.spoiled) continue;
        rows.log_probs = episode.log_probs;
        set.append(rows);
        progress(set.length());
    }
    Hdf5Writer file(path);
    write_gym_set(file, set, steps);
    write_policy(file, policy, static_cast<size_t>(task.state_dim));
    write_origin(file, origin);
    file.close();
}

// The last `steps` rows of a run's buffer. It holds single precision, neither qpos nor qvel, and live columns alone; but
// an episode is a function of its number and its actions, so all of it is found again by playing it once more.
// Errors: collect.replay.
inline GymSet<double> retrace(const sac::Learner& learner, LiveTask& environment, size_t steps) {
    const sac::Replay& replay = learner.replay;
    const Random resets{learner.settings.seed, Stream::environment};
    std::vector<float> state(static_cast<size_t>(replay.state_dim));
    const auto is_at = [&](const float* row) { return std::equal(state.begin(), state.end(), row); };
    struct Part {
        uint64_t episode, first, last;  // rows back from the one to be written next, first >= last
    };
    std::vector<Part> parts;  // the newest first
    uint64_t episode = learner.progress.episodes, last = 1;
    for (uint64_t back = 1; back <= replay.size() && last <= steps; ++back) {
        if (back < replay.size() && replay.end(replay.recent(back + 1)) == sac::End::none) continue;
        // An episode that the engine spoiled at its first step has a number and no rows; so has one not begun yet.
        while (environment.reset(resets, episode, state.data()), !is_at(replay.row(replay.recent(back))))
            if (episode-- == 0)
                fail("collect.replay", "no episode of the run begins as the row %zu before its last", back);
        parts.push_back({episode, back, last});
        if (episode > 0) --episode;
        last = back + 1;
    }
    GymSet<double> set;
    for (; !parts.empty(); parts.pop_back()) {
        const Part& part = parts.back();
        environment.reset(resets, part.episode, state.data());
        for (uint64_t back = part.first; back >= part.last; --back) {
            const size_t row = replay.recent(back);
            if (back <= steps) set.before(environment.body);
            const Step step = environment.step(replay.action(row), state.data());
            if (!is_at(replay.next_state(row)))
                fail("collect.replay", "episode %llu went another way when it was played again",
                     static_cast<unsigned long long>(part.episode));
            if (back <= steps) set.after(environment.body, {replay.action(row), environment.body.control.size()}, step);
        }
        // Cut by the engine, or collection stopped there: a timeout, as at the end of D4RL's collection blocks.
        if (set.terminals.back() == 0) set.timeouts.back() = 1;
    }
    return set;
}

// Trains, or goes on training from the checkpoint, and writes the buffer to FILE and the policy to
// FILE.policy.safetensors. If the level is reached before the buffer has `steps` rows, the policy as it is then fills the
// rest. Errors: collect.stopped, collect.replay.
inline void collect_medium_replay(const std::string& path, const MujocoTask& task, size_t steps, const Origin& origin,
                                  const Training& training, const std::string& checkpoint, const Watch& watch) {
    LiveTask environment(task);
    Compute compute(best_kernel(), training.threads);
    sac::Learner learner(training.settings, environment.spec(), compute);
    const Moments returns = train_to_level(learner, environment, training, checkpoint, watch);
    save_trained_policy(path + ".policy.safetensors", learner, training, returns);
    while (learner.replay.size() < steps) learner.interact(environment);
    const GymSet<double> set = retrace(learner, environment, steps);
    Hdf5Writer file(path);
    write_gym_set(file, set, steps);
    // D4RL's number of the checkpoint, which counts rlkit's epochs of 1000 updates.
    file.add("metadata/iteration", {1}, std::array{static_cast<int32_t>(learner.progress.updates / 1000)});
    write_origin(file, origin);
    file.close();
}

// The policy of antmaze's walker, trained in the same way.
inline void train_walker(const std::string& path, const Training& training, const std::string& checkpoint,
                         const Watch& watch) {
    WalkingAnt environment;
    Compute compute(best_kernel(), training.threads);
    sac::Learner learner(training.settings, environment.spec(), compute);
    const Moments returns = train_to_level(learner, environment, training, checkpoint, watch);
    save_trained_policy(path, learner, training, returns);
}

#endif  // WODTEM_MUJOCO
