// state.hpp: how the parts of a run's state are written to a checkpoint and read back. Each function calls
// archive(name, field) for its fields; `Saver` and `Loader` of safetensors.hpp are such archives.
//
// Promises: what was saved is loaded to the same bits; what no run can have saved is refused before it is used.
// Leaves out: files; what a run consists of (wodtem.cpp).
#pragma once

#include "../memory.hpp"  // and with it nn.hpp and the standard headers

// Visits trained parameters and the state of their optimiser: "NAME.updates", then for each parameter "NAME.value.P",
// "NAME.first_moment.P" and "NAME.second_moment.P". Values are loaded in place, because tensors point at them; moments
// that no update has touched yet are saved as zeros.
template <class Archive>
void visit_trained(Archive& archive, const std::string& name, std::vector<Parameter<float>>& parameters,
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
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// The replay buffer: trajectories laid end to end; returns are computed again.

// Visits states [steps, state_dim], actions [steps, action_dim] and rewards [steps] of all trajectories, and each one's
// length and end. Errors: checkpoint.replay if the sizes do not fit together; those of relabel().
template <class Archive>
void visit_replay(Archive& archive, ReplayBuffer& replay) {
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
    const size_t steps = std::accumulate(lengths.begin(), lengths.end(), size_t{0});
    if (count != terminated.size() || count > replay.capacity || steps != rewards.size() ||
        states.size() != steps * S || actions.size() != steps * A ||
        replay.next >= std::max<size_t>(replay.capacity, 1) || (count < replay.capacity && replay.next != 0))
        fail("checkpoint.replay",
             "the replay buffer does not fit together: %zu trajectories of %zu steps in all (at most %zu "
             "trajectories), %zu flags, %zu states of %zu, %zu actions of %zu, %zu rewards, next %zu",
             count, steps, replay.capacity, terminated.size(), states.size(), S, actions.size(), A, rewards.size(),
             static_cast<size_t>(replay.next));
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

// Errors: checkpoint.memory names the column and the condition that no run can have broken.
template <class Archive>
void visit_memory(Archive& archive, EpisodicMemory& memory) {
    EpisodicMemory::for_each_column(memory, [&](const char* name, auto& column, size_t) { archive(name, column); });
    archive("memory.projection", memory.projection);
    archive("memory.accesses", memory.accesses);
    archive("memory.insertions", memory.insertions);
    if (!archive.loading) return;

    const auto require = [](bool holds, const char* name, const char* condition) {
        if (!holds) fail("checkpoint.memory", "the episodic memory does not fit together: %s %s", name, condition);
    };
    const auto has_repetition = [](auto values) {
        std::sort(values.begin(), values.end());
        return std::adjacent_find(values.begin(), values.end()) != values.end();
    };
    const size_t n = memory.size(), cells = static_cast<size_t>(memory.config.projected_dim) * memory.S;
    require(n <= memory.config.capacity, "memory.e", "has more entries than the table may hold");
    EpisodicMemory::for_each_column(memory, [&](const char* name, const auto& column, size_t width) {
        require(column.size() == n * width, name, "has a wrong number of values");
        for (const auto value : column)
            require(std::isfinite(static_cast<double>(value)), name, "holds a number that is not finite");
    });
    require(memory.projection.size() == cells, "memory.projection", "has a wrong number of values");
    for (const double value : memory.projection) require(std::isfinite(value), "memory.projection", "is not finite");
    require(!has_repetition(memory.age), "memory.age", "repeats itself");
    for (const uint64_t value : memory.age)
        require(value < memory.insertions, "memory.age", "exceeds memory.insertions");
    for (const uint64_t value : memory.priority)
        require(value >= 1 && value <= memory.accesses, "memory.priority", "lies outside 1 .. memory.accesses");
    std::vector<Words4> keys;
    for (size_t i = 0; i < n; ++i) keys.push_back(memory.key_of(i));
    require(!has_repetition(keys), "memory.keys", "holds a key twice");
    memory.rebuild_derived();
}
