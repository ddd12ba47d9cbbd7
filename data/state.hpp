// state.hpp: how the parts of a run's state are written to a checkpoint and read back. Each function calls
// archive(name, field) for its fields; `Saver` and `Loader` of safetensors.hpp are such archives.
//
// Promises: what was saved is loaded to the same bits; what no run can have saved is refused before it is used.
// Leaves out: files; what a run consists of (wodtem.cpp).
#pragma once

#include "../memory.hpp"  // and with it nn.hpp and the standard headers

// Errors: checkpoint.entry names the entry and the condition that no run can have broken.
inline void require_entry(bool holds, const std::string& entry, const char* condition) {
    if (!holds) fail("checkpoint.entry", "the entry %s %s", entry.c_str(), condition);
}

inline void require_finite(const std::string& entry, const auto& values) {
    for (const auto value : values)
        require_entry(std::isfinite(static_cast<double>(value)), entry, "holds a number that is not finite");
}

// moves: how many discrete actions there are to choose from; 0: actions are continuous.
inline void require_actions(const std::string& entry, const std::vector<float>& actions, int moves) {
    require_finite(entry, actions);
    for (const float action : actions)
        require_entry(moves == 0 || (action >= 0 && action < static_cast<float>(moves) && action == std::floor(action)),
                      entry, "holds an action that is no move");
}

// Visits trained parameters and the state of their optimiser: "NAME.updates", then for each parameter "NAME.value.P",
// "NAME.first_moment.P" and "NAME.second_moment.P". Values are loaded in place, because tensors point at them; moments
// that no update has touched yet are saved as zeros. Errors: checkpoint.entry.
void visit_trained(auto& archive, const std::string& name, std::vector<Parameter<float>>& parameters,
                   Optimizer& optimizer) {
    archive(name + ".updates", optimizer.updates);
    optimizer.first_moment.resize(parameters.size());
    optimizer.second_moment.resize(parameters.size());
    for (size_t i = 0; i < parameters.size(); ++i) {
        const std::string& parameter = parameters[i].name;
        optimizer.first_moment[i].resize(parameters[i].value.size());
        optimizer.second_moment[i].resize(parameters[i].value.size());
        archive(name + ".value." + parameter, parameters[i].value);
        archive(name + ".first_moment." + parameter, optimizer.first_moment[i]);
        archive(name + ".second_moment." + parameter, optimizer.second_moment[i]);
        if (!archive.loading) continue;
        require_finite(name + ".value." + parameter, parameters[i].value);
        require_finite(name + ".first_moment." + parameter, optimizer.first_moment[i]);
        for (const float value : optimizer.second_moment[i])  // a sum of squares, which may have become infinite
            require_entry(value >= 0, name + ".second_moment." + parameter, "holds a number that is not 0 or more");
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// The replay buffer: trajectories laid end to end; returns are computed again.

// Visits states [steps, state_dim], actions [steps, action_dim] and rewards [steps] of all trajectories, and each one's
// length and end. moves: see require_actions(). Errors: checkpoint.entry.
void visit_replay(auto& archive, ReplayBuffer& replay, int moves) {
    std::vector<float> states, actions, rewards;
    std::vector<uint32_t> lengths, terminated;
    const auto append = [](auto& all, const auto& part) { all.insert(all.end(), part.begin(), part.end()); };
    if (!archive.loading)
        for (const Trajectory& trajectory : replay.trajectories) {
            append(states, trajectory.states);
            append(actions, trajectory.actions);
            append(rewards, trajectory.rewards);
            lengths.push_back(static_cast<uint32_t>(trajectory.length()));
            terminated.push_back(trajectory.terminated);
        }
    archive("replay.states", states);
    archive("replay.actions", actions);
    archive("replay.rewards", rewards);
    archive("replay.lengths", lengths);
    archive("replay.terminated", terminated);
    archive("replay.next", replay.next);
    if (!archive.loading) return;

    const size_t S = replay.state_dim, A = replay.action_dim, count = lengths.size();
    require_entry(count >= 1 && count <= replay.capacity, "replay.lengths", "has none or more than the buffer holds");
    for (const uint32_t length : lengths)  // a number of a trajectory is indexed by an int
        require_entry(length >= 1 && length <= INT32_MAX / std::max(S, A), "replay.lengths",
                      "holds a length of no trajectory");
    const size_t steps = std::accumulate(lengths.begin(), lengths.end(), size_t{0});
    require_entry(terminated.size() == count, "replay.terminated", "has not one flag for each of replay.lengths");
    for (const uint32_t flag : terminated)
        require_entry(flag <= 1, "replay.terminated", "holds a flag that is neither 0 nor 1");
    const char* const wrong_size = "has not as many numbers as replay.lengths call for";
    require_entry(states.size() == steps * S, "replay.states", wrong_size);
    require_entry(actions.size() == steps * A, "replay.actions", wrong_size);
    require_entry(rewards.size() == steps, "replay.rewards", wrong_size);
    require_finite("replay.states", states);
    require_actions("replay.actions", actions, moves);
    require_finite("replay.rewards", rewards);
    require_entry(count < replay.capacity ? replay.next == 0 : replay.next < replay.capacity, "replay.next",
                  "is not the number of a trajectory to be overwritten");
    replay.trajectories.assign(count, {});
    for (size_t i = 0, t = 0; i < count; t += lengths[i], ++i) {
        Trajectory& trajectory = replay.trajectories[i];
        const auto take = [&](std::vector<float>& part, const std::vector<float>& all, size_t width) {
            part.assign(all.data() + t * width, all.data() + (t + lengths[i]) * width);
        };
        take(trajectory.states, states, S);
        take(trajectory.actions, actions, A);
        take(trajectory.rewards, rewards, 1);
        trajectory.terminated = terminated[i] != 0;
        relabel(trajectory, replay.state_dim, replay.action_dim, replay.gamma);
    }
    replay.count_steps();
}

// ---------------------------------------------------------------------------------------------------------------------
// The episodic memory: its columns; everything else is derived from them.

// moves: see require_actions(). Errors: checkpoint.entry.
void visit_memory(auto& archive, EpisodicMemory& memory, int moves) {
    EpisodicMemory::for_each_column(memory, [&](const char* name, auto& column, size_t) { archive(name, column); });
    archive("memory.projection", memory.projection);
    archive("memory.accesses", memory.accesses);
    archive("memory.insertions", memory.insertions);
    if (!archive.loading) return;

    const auto has_repetition = [](auto values) {
        std::sort(values.begin(), values.end());
        return std::adjacent_find(values.begin(), values.end()) != values.end();
    };
    const size_t n = memory.size(), cells = static_cast<size_t>(memory.config.projected_dim) * memory.S;
    require_entry(n <= memory.config.capacity, "memory.e", "has more entries than the table may hold");
    EpisodicMemory::for_each_column(memory, [&](const char* name, const auto& column, size_t width) {
        require_entry(column.size() == n * width, name, "has a wrong number of values");
        require_finite(name, column);
    });
    require_actions("memory.actions", memory.actions, moves);
    require_entry(memory.projection.size() == cells, "memory.projection", "has a wrong number of values");
    require_finite("memory.projection", memory.projection);
    // Each insertion is an access; before the table is full nothing is removed; 2^62 is out of any run's reach.
    require_entry(memory.accesses < uint64_t{1} << 62, "memory.accesses", "is more than a run can count");
    require_entry(memory.insertions <= memory.accesses, "memory.insertions", "exceeds memory.accesses");
    require_entry(n == memory.config.capacity || memory.insertions == n, "memory.insertions",
                  "is not the number of entries, though the table was never full");
    require_entry(!has_repetition(memory.age), "memory.age", "repeats itself");
    for (const uint64_t value : memory.age)
        require_entry(value < memory.insertions, "memory.age", "exceeds memory.insertions");
    for (const uint64_t value : memory.priority)
        require_entry(value >= 1 && value <= memory.accesses, "memory.priority", "lies outside 1 .. memory.accesses");
    std::vector<Words4> keys;
    for (size_t i = 0; i < n; ++i) keys.push_back(memory.key_of(i));
    require_entry(!has_repetition(keys), "memory.keys", "holds a key twice");
    memory.rebuild_derived();
}

// Refuses a temperature, a normaliser and counts that no run can have saved. Errors: checkpoint.entry.
void check_state(auto& run) {
    require_finite("temperature.value.log_temperature", std::array{run.agent.temperature.lambda()});
    require_finite("normaliser.mean", run.agent.normaliser.mean);
    require_finite("normaliser.deviation", run.agent.normaliser.deviation);
    for (const float deviation : run.agent.normaliser.deviation)
        require_entry(deviation > 0, "normaliser.deviation", "holds a number that is not positive");
    // Counts follow from the schedule of the phases.
    const auto& p = run.progress;
    const auto& settings = run.agent.settings;
    const auto count = [](int64_t setting) { return static_cast<uint64_t>(setting); };  // none exceeds 1e9
    const uint64_t offline = count(settings.offline_updates), each = count(settings.updates_per_iteration);
    const uint64_t every = count(settings.eval_every), budget = count(settings.online_steps);
    const bool online = p.online == 1;
    require_entry(p.online <= (budget > 0 ? 1u : 0u), "progress.online", "names no phase of this run");
    // An episode begins below the budget and has a step or more.
    const uint64_t most = online ? budget + count(run.agent.spec.max_episode_steps) - 1 : 0;
    require_entry(p.interactions <= most, "progress.interactions", "is more than this phase makes");
    require_entry(p.episodes <= p.interactions, "progress.episodes", "exceeds progress.interactions");
    // An episode begins when the updates of those before it are made.
    const uint64_t due = offline + p.episodes * each;
    require_entry(p.updates <= due && (!online || p.updates >= due - (p.episodes > 0 ? each : 0)), "progress.updates",
                  "does not fit progress.episodes");
    const bool own = settings.state_dim > 0;  // own data, whose rows follow from the updates
    const uint64_t most_evaluations = own ? p.updates + 1 : online ? 1 + p.episodes / every : 0;
    require_entry(p.evaluations <= most_evaluations && (!online || p.evaluations >= 1), "progress.evaluations",
                  "does not fit progress.episodes");
    require_entry(p.next_evaluation == (own ? 0 : p.evaluations * every) && p.next_evaluation >= p.episodes,
                  "progress.next_evaluation", "does not fit progress.evaluations and progress.episodes");
    require_entry(!std::isinf(p.eval_length), "progress.eval_length", "is infinite");
    require_entry(!std::isinf(p.eval_return), "progress.eval_return", "is infinite");
    const auto require_sum = [](const char* name, double sum) { require_finite(name, std::array{sum}); };
    run.tally.visit(require_sum);
    require_finite("progress.advice_shift", run.tally.advice_shift);
    require_entry(run.optimizer.updates == p.updates, "model.updates", "is not progress.updates");
    require_entry(run.agent.temperature.optimizer.updates == (run.agent.constrains_entropy() ? p.updates : 0),
                  "temperature.updates", "is not progress.updates, or 0 where the entropy is not constrained");
}
