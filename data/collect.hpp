// collect.hpp: makes data sets of D4RL's kinds, in D4RL's layout: maze2d by its planner and controller (waypoints.hpp),
// the medium sets of the gym tasks by sampling from a soft actor-critic policy (sac.hpp) that data/policies holds.
// Promises: a data set is a function of (task, steps, seed, machine); its metadata say how it was made, so that nobody
// takes it for D4RL's. Leaves out: medium-replay and antmaze sets, training of policies.
#pragma once

#include <functional>
#include <string>
#include <vector>

#include "d4rl.hpp"
#include "sac.hpp"
#include "waypoints.hpp"

#ifdef WODTEM_MUJOCO

// A file's bytes as they were when this was compiled, and where they end.
#define WODTEM_EMBED(name, path)                                                                         \
    asm(".pushsection .rodata\n" #name ": .incbin \"" path "\"\n" #name "_end: .byte 0\n.popsection\n"); \
    extern "C" const char name[], name##_end[];
WODTEM_EMBED(wodtem_hopper_medium, "data/policies/hopper-medium.safetensors")
WODTEM_EMBED(wodtem_halfcheetah_medium, "data/policies/halfcheetah-medium.safetensors")
#undef WODTEM_EMBED

// The policies that the medium sets are sampled from. Errors: collect.task.
inline sac::SavedPolicy medium_policy(const MujocoTask& task) {
    struct Embedded {
        const char *task, *begin, *end;
    };
    for (const Embedded& one : {Embedded{"hopper", wodtem_hopper_medium, wodtem_hopper_medium_end},
                                {"halfcheetah", wodtem_halfcheetah_medium, wodtem_halfcheetah_medium_end}})
        if (std::string_view(task.name) == one.task)
            return sac::policy_of(
                parse_safetensors(std::string(one.begin, one.end), std::string(task.name) + "'s medium policy"));
    fail("collect.task", "there is no policy for %s's medium set in this version; hopper and halfcheetah have one",
         task.name);
}

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

// D4RL's layout of maze2d: eight data sets of N rows, here with the flags as booleans.
inline void collect_maze2d(const std::string& path, const MujocoTask& task, size_t steps, const Origin& origin,
                           const std::function<void(size_t)>& progress) {
    const MazeDataSet set = collect_maze_data_set(task, steps, origin.seed, progress);
    const auto flags = [](const std::vector<float>& values) {
        return std::vector<uint8_t>(values.begin(), values.end());
    };
    Hdf5Writer file(path);
    file.add("observations", {steps, 4}, set.observations);
    file.add("actions", {steps, 2}, set.actions);
    file.add("rewards", {steps}, set.rewards);
    file.add("terminals", {steps}, flags(set.terminals));
    file.add("timeouts", {steps}, flags(set.timeouts));
    file.add("infos/goal", {steps, 2}, set.goal);
    file.add("infos/qpos", {steps, 2}, set.qpos);
    file.add("infos/qvel", {steps, 2}, set.qvel);
    write_origin(file, origin);
    file.close();
}

// The first `steps` rows of whole episodes of sampled actions. At the last step allowed only the timeout is set, also if
// the agent fell on it, as in D4RL. An episode that the engine spoils is left out.
inline void collect_medium(const std::string& path, const MujocoTask& task, size_t steps, const Origin& origin,
                           const std::function<void(size_t)>& progress) {
    sac::SavedPolicy policy = medium_policy(task);
    MujocoEnvironment environment(task, Physics::d4rl);
    const uint64_t S = static_cast<uint64_t>(task.state_dim), A = static_cast<uint64_t>(task.action_dim),
                   Q = static_cast<uint64_t>(environment.model->nq), V = static_cast<uint64_t>(environment.model->nv);
    Compute compute(choose_kernel("auto"), 1);
    Tape<float> tape(compute);
    tape.recording = false;
    std::vector<float> observations, next_observations, actions, rewards, log_probs, qpos, qvel;
    std::vector<uint8_t> terminals, timeouts;
    const auto append = [](auto& to, const auto& from) { to.insert(to.end(), from.begin(), from.end()); };
    for (uint64_t number = data_set_episodes; rewards.size() < steps; ++number) {
        std::vector<float> episode_qpos, episode_qvel;
        const sac::Episode episode = sac::play(tape, policy.network, environment, origin.seed, number, true, [&] {
            append(episode_qpos, std::span(environment.data->qpos, Q));
            append(episode_qvel, std::span(environment.data->qvel, V));
        });
        if (episode.spoiled) continue;
        append(observations, episode.states);
        append(next_observations, std::span(episode.states).subspan(S));
        append(next_observations, episode.last_state);
        append(actions, episode.actions);
        append(rewards, episode.rewards);
        append(log_probs, episode.log_probs);
        append(qpos, episode_qpos);
        append(qvel, episode_qvel);
        terminals.resize(rewards.size()), timeouts.resize(rewards.size());
        const bool limit = episode.rewards.size() == static_cast<size_t>(task.max_episode_steps);
        (limit ? timeouts : terminals).back() = 1;
        progress(rewards.size());
    }
    Hdf5Writer file(path);
    const auto add = [&](const char* name, const auto& values, uint64_t width) {
        file.add(name, width > 0 ? Shape{steps, width} : Shape{steps},
                 std::span(values).first(steps * std::max<uint64_t>(width, 1)));
    };
    add("observations", observations, S);
    add("next_observations", next_observations, S);
    add("actions", actions, A);
    add("rewards", rewards, 0);
    add("terminals", terminals, 0);
    add("timeouts", timeouts, 0);
    add("infos/action_log_probs", log_probs, 0);
    add("infos/qpos", qpos, Q);
    add("infos/qvel", qvel, V);
    write_origin(file, origin);
    file.text("metadata/algorithm", "SAC");
    file.text("metadata/policy/nonlinearity", "relu");
    file.text("metadata/policy/output_distribution", "tanh_gaussian");
    sac::each_policy_tensor(policy.network.parameters,
                            [&](std::string name, const Shape& shape, std::span<const float> values) {
                                std::replace(name.begin(), name.end(), '.', '/');
                                file.add("metadata/policy/" + name, shape, values);
                            });
    file.close();
}

#endif  // WODTEM_MUJOCO
