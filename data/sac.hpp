// sac.hpp: soft actor-critic (SAC), whose policies made D4RL's locomotion data; it trains the policies of our
// stand-ins. Haarnoja et al., "Soft Actor-Critic Algorithms and Applications", arXiv 1812.05905 (below: SAC), with the
// defaults of rlkit (github.com/rail-berkeley/rlkit, torch/sac), which stand at Settings.
//
// In order: settings; replay; networks; the losses and the target; acting; the learner; files. The losses are
// templates on the scalar, as all of nn.hpp: float trains, double checks them against finite differences.
// Promises: a run is a function of its settings (for one instruction set), for any number of threads and however often
// it was stopped and resumed. Leaves out: discrete actions, normalised observations, several environments at once.
//
// Random streams of nn.hpp (a run of SAC has a seed of its own):
//   initialisation  step: tensor, numbered through the policy, then the critics; index: element
//   environment     step: episode; evaluations as the caller numbers them
//   exploration     step: episode; index: time-step; site: action dimension. First a uniform, later a normal number
//   batch           step: update; index: row of the batch
//   entropy_noise   step: update; index: row; site: action dimension of a ~ pi(s), plus action_dim of a' ~ pi(s')
#pragma once

#include "../memory.hpp"  // and with it nn.hpp and the standard headers
#include "safetensors.hpp"
#include "state.hpp"

namespace sac {

// SAC's table 1 and rlkit's defaults (examples/sac.py), except for random_steps. rlkit lets the untrained policy act
// for 1000 steps, then alternates 1000 steps and 1000 updates. Here 10,000 uniformly random actions come first (as in
// the code of SAC's authors for some tasks, and in OpenAI's Spinning Up), then as many updates as steps.
struct Settings {
    uint32_t seed = 0;
    int hidden = 256;  // ReLU units in each of two layers
    int batch = 256;
    uint64_t capacity = 1000000;  // transitions; the oldest are overwritten
    uint64_t random_steps = 10000;
    uint64_t steps_per_update = 1;  // of the environment
    double learning_rate = 3e-4;    // Adam's, for policy, critics and temperature
    double discount = 0.99;
    double target_rate = 5e-3;
    double reward_scale = 1;
};

// ---------------------------------------------------------------------------------------------------------------------
// Replay.

enum class End { none = 0, terminated = 1, cut = 2 };  // cut: by the time limit or a broken-down simulation

// A ring buffer of rows: state [S], action [A], reward, End, next state [S], episode's number (exact up to 2^24).
struct Replay {
    int state_dim, action_dim;
    uint64_t capacity;
    uint64_t next = 0;  // the row that is written next
    std::vector<float> rows = {};

    size_t width() const { return 2 * state_dim + action_dim + 3; }
    size_t size() const { return rows.size() / width(); }
    const float* row(size_t i) const { return rows.data() + i * width(); }
    const float* action(size_t i) const { return row(i) + state_dim; }
    float reward(size_t i) const { return action(i)[action_dim]; }
    End end(size_t i) const { return static_cast<End>(static_cast<int>(action(i)[action_dim + 1])); }
    const float* next_state(size_t i) const { return action(i) + action_dim + 2; }
    uint64_t episode(size_t i) const { return static_cast<uint64_t>(next_state(i)[state_dim]); }
    // The index of the row that was written `back` rows before the next one, back >= 1.
    size_t recent(uint64_t back) const { return (next + capacity - back) % capacity; }

    void add(const float* state, const float* action, double reward, End end, const float* next_state,
             uint64_t episode) {
        if (size() < capacity) rows.resize(rows.size() + width());
        float* to = rows.data() + next * width();
        to = std::copy_n(action, action_dim, std::copy_n(state, state_dim, to));
        *to++ = static_cast<float>(reward);
        *to++ = static_cast<float>(end);
        to = std::copy_n(next_state, state_dim, to);
        *to = static_cast<float>(episode);
        next = (next + 1) % capacity;
    }
    void cut_last() { rows[recent(1) * width() + state_dim + action_dim + 1] = static_cast<float>(End::cut); }

    void visit(auto& archive) {
        archive("replay.next", next);
        archive("replay.rows", rows);
        const bool fits = size() < capacity ? next == size() : size() == capacity && next < capacity;
        require(fits && rows.size() % width() == 0, "checkpoint.shape", "the replay's rows do not fit its width, ",
                width());
    }
};

// ---------------------------------------------------------------------------------------------------------------------
// Networks.

template <class T>
struct Network {
    std::vector<Parameter<T>> parameters;  // weight [out, in] and bias [out] of fc0, fc1 and last_fc

    // rlkit's initialisation: hidden weights uniform in +-1 / sqrt(outputs) (rlkit takes the wrong side of the matrix
    // for its fan-in), hidden biases 0.1, last layer uniform in +-last_range. first_tensor: the first one's number.
    Network(uint64_t in, uint64_t hidden, uint64_t out, double last_range, uint32_t seed, uint64_t first_tensor) {
        const Random random{seed, Stream::initialisation};
        const auto add = [&](const char* name, const Shape& shape, double range) {
            const size_t size = shape[0] * (shape.size() == 2 ? shape[1] : 1);
            Parameter<T> p{name, shape, std::vector<T>(size, T(0.1)), std::vector<T>(size)};
            for (uint32_t i = 0; range > 0 && i < size; ++i)
                p.value[i] = static_cast<T>(range * (2 * random.uniform(first_tensor + parameters.size(), i) - 1));
            parameters.push_back(std::move(p));
        };
        add("fc0.weight", {hidden, in}, 1 / std::sqrt(hidden));
        add("fc0.bias", {hidden}, 0);
        add("fc1.weight", {hidden, hidden}, 1 / std::sqrt(hidden));
        add("fc1.bias", {hidden}, 0);
        add("last_fc.weight", {out, hidden}, last_range);
        add("last_fc.bias", {out}, last_range);
    }
    int inputs() const { return static_cast<int>(parameters[0].shape[1]); }
    int outputs() const { return static_cast<int>(parameters[4].shape[0]); }
};

template <class T>
using Pair = std::array<Network<T>, 2>;  // SAC sec. 6: two critics against overestimation

// A dense layer: y [n, out] = x W^T + b, with ReLU if `rectified`. Without `trained` no gradient reaches W and b. It
// makes fewer passes over y than linear() of nn.hpp, and packs no matrix for a single row.
template <class T>
Tensor<T> dense(Tape<T>& tape, Tensor<T> x, Parameter<T>& weight, Parameter<T>& bias, bool rectified, bool trained) {
    const int in = x.columns, out = weight.rows();
    const Tensor<T> y = tape.make(x.rows, out), w = weight.tensor(), b = bias.tensor();
    Compute& compute = tape.compute;
    const View<T> sums = {y.value, out};
    const Epilogue<T> add_bias = {b.value, rectified};
    if (x.rows == 1) {
        for (ptrdiff_t j = 0; j < out; ++j) y.value[j] = dot(x.value, w.value + j * in, in);
        apply_epilogue(sums, add_bias, {0, 1, 0, out});
    } else {
        matmul(compute, sums, {x.value, in}, {w.value, in, true}, x.rows, out, in, Store::overwrite, add_bias);
    }
    tape.on_backward(y, [=, &compute] {
        const View<const T> dy = {y.grad(), out}, dy_transposed = {y.grad(), out, true};
        if (rectified)
            for (size_t i = 0; i < y.size(); ++i) y.grad()[i] = y.value[i] > 0 ? y.grad()[i] : T(0);
        if (x.gradient) {  // dx += dy W
            const Store store = next_store(x);
            matmul(compute, View<T>{x.grad(), in}, dy, {w.value, in}, x.rows, in, out, store);
        }
        if (!trained) return;
        // dW += dy^T x
        matmul(compute, View<T>{w.grad(), in}, dy_transposed, {x.value, in}, out, in, x.rows, Store::accumulate);
        add_column_sums(compute, b.grad(), y.grad(), y.rows, out, out);
    });
    return y;
}

// The network's output [n, out] for x [n, in]. `trained`: see dense().
template <class T>
Tensor<T> forward(Tape<T>& tape, Network<T>& network, Tensor<T> x, bool trained = true) {
    std::vector<Parameter<T>>& p = network.parameters;
    const Tensor<T> first = dense(tape, x, p[0], p[1], true, trained);
    const Tensor<T> second = dense(tape, first, p[2], p[3], true, trained);
    return dense(tape, second, p[4], p[5], false, trained);
}

// ---------------------------------------------------------------------------------------------------------------------
// The losses.

// Rows of the replay; state and action side by side are a pair.
template <class T>
struct Batch {
    Tensor<T> states, pairs, rewards, ends, next_states;  // [n, S], [n, S + A], [n, 1], [n, 1] as numbers, [n, S]
};

// The rows pick(0), ..., pick(n - 1) of the replay.
template <class T, class Pick>
Batch<T> gather(Tape<T>& tape, const Replay& replay, uint32_t n, Pick&& pick) {
    const int S = replay.state_dim, A = replay.action_dim;
    std::vector<const float*> rows;
    for (uint32_t i = 0; i < n; ++i) rows.push_back(replay.row(pick(i)));
    const auto columns = [&](int first, int count) {
        std::vector<float> x;
        for (const float* row : rows) x.insert(x.end(), row + first, row + first + count);
        return tape.constant(x.data(), n, count);
    };
    return {columns(0, S), columns(0, S + A), columns(S + A, 1), columns(S + A + 1, 1), columns(S + A + 2, S)};
}

template <class T>
struct Sample {
    Tensor<T> pairs, log_prob;  // [n, S + A] states and the actions drawn at them, in [-1, 1]; [n, 1]
};

// SAC app. C, reparametrised: a = tanh(u), u = m + exp(l) noise, and
// log pi(a) = log N(u; m, exp(l)) - sum log(1 - tanh(u)^2). output [n, 2A]: the policy's at `states` [n, S], m, then l,
// which rlkit clamps to [-20, 2]. noise [n, A]: standard normal. The gradient goes through the actions alone.
template <class T>
Sample<T> draw(Tape<T>& tape, Tensor<T> states, Tensor<T> output, const float* noise) {
    const int n = output.rows, S = states.columns, A = output.columns / 2, width = S + A;
    const Tensor<T> pairs = tape.make(n, width), log_prob = tape.make(n, 1), normal = tape.constant(noise, n, A);
    for (ptrdiff_t row = 0; row < n; ++row) {
        const T *mean = output.value + row * 2 * A, *l = mean + A, *z = normal.value + row * A;
        T* const action = std::copy_n(states.value + row * S, S, pairs.value + row * width);
        log_prob.value[row] = 0;
        for (ptrdiff_t j = 0; j < A; ++j) {
            const T log_std = std::clamp(l[j], T(-20), T(2)), u = mean[j] + std::exp(log_std) * z[j];
            action[j] = std::tanh(u);
            log_prob.value[row] -= T(0.5) * z[j] * z[j] + log_std + T(half_log_2_pi) + log_tanh_slope(u);
        }
    }
    tape.on_backward({}, [=] {  // there are two results, so the step is never skipped
        const T *d_pairs = gradient_of(pairs), *d_log_prob_of = gradient_of(log_prob);
        T* const d_output = gradient_of(output);
        for (ptrdiff_t i = 0; i < ptrdiff_t{n} * A; ++i) {
            const ptrdiff_t action = i / A * width + S + i % A, mean = i / A * 2 * A + i % A, l = mean + A;
            const T a = pairs.value[action], d_log_prob = d_log_prob_of[i / A], log_std = output.value[l];
            const T du = (T(1) - a * a) * d_pairs[action] + T(2) * a * d_log_prob;
            d_output[mean] += du;
            if (log_std >= T(-20) && log_std <= T(2))
                d_output[l] += du * std::exp(log_std) * normal.value[i] - d_log_prob;
        }
    });
    return {pairs, log_prob};
}

// min_k Q_k(s, a), [n, 1], of pairs [n, S + A]. The gradient of a row goes through the critic that gave the minimum, to
// the pairs alone: the critics' parameters get none.
template <class T>
Tensor<T> least_q(Tape<T>& tape, Pair<T>& critics, Tensor<T> pairs) {
    const Tensor<T> q0 = forward(tape, critics[0], pairs, false), q1 = forward(tape, critics[1], pairs, false);
    const Tensor<T> y = tape.make(pairs.rows, 1);
    for (ptrdiff_t i = 0; i < y.rows; ++i) y.value[i] = q1.value[i] < q0.value[i] ? q1.value[i] : q0.value[i];
    tape.on_backward(y, [=] {
        T *const d_q0 = gradient_of(q0), *const d_q1 = gradient_of(q1);
        for (ptrdiff_t i = 0; i < y.rows; ++i) (q1.value[i] < q0.value[i] ? d_q1 : d_q0)[i] += y.grad()[i];
    });
    return y;
}

// SAC eq. (5) and (3): y [n] = scale r + gamma (1 - terminated) (min_k Qbar_k(s', a') - alpha log pi(a' | s')),
// with a' ~ pi(s') drawn by `noise` [n, A]. It has no gradient and is valid until the tape is reset.
template <class T>
const float* q_target(Tape<T>& tape, Network<T>& policy, Pair<T>& targets, const Batch<T>& batch, const float* noise,
                      T alpha, const Settings& settings) {
    const bool recording = std::exchange(tape.recording, false);
    const Sample<T> sample = draw(tape, batch.next_states, forward(tape, policy, batch.next_states), noise);
    const Tensor<T> q = least_q(tape, targets, sample.pairs);
    tape.recording = recording;
    float* y = tape.template scratch<float>(q.size());
    const T scale = static_cast<T>(settings.reward_scale), discount = static_cast<T>(settings.discount);
    for (size_t i = 0; i < q.size(); ++i) {
        // A time limit is no part of the task: the target bootstraps from the state after it.
        const T rate = batch.ends.value[i] == static_cast<T>(End::terminated) ? T(0) : discount;
        y[i] =
            static_cast<float>(scale * batch.rewards.value[i] + rate * (q.value[i] - alpha * sample.log_prob.value[i]));
    }
    return y;
}

// The mean of x [n, 1], [1, 1].
template <class T>
Tensor<T> mean(Tape<T>& tape, Tensor<T> x) {
    const std::vector<float> shares(x.size(), 1.0f / static_cast<float>(x.rows));
    return weighted_sum(tape, x, shares.data());
}

// SAC eq. (5) without its 1/2, as rlkit: J_Q = sum_k mean (Q_k(s, a) - y)^2, [1, 1]. target [n].
template <class T>
Tensor<T> critic_loss(Tape<T>& tape, Pair<T>& critics, const Batch<T>& batch, const float* target) {
    const Tensor<T> q0 = forward(tape, critics[0], batch.pairs), q1 = forward(tape, critics[1], batch.pairs);
    return combine(tape, T(1), mean(tape, squared_error(tape, q0, target)), T(1),
                   mean(tape, squared_error(tape, q1, target)));
}

// SAC eq. (9): J_pi = mean (alpha log pi(a | s) - min_k Q_k(s, a)), a = `sample` of the policy at s, [1, 1].
template <class T>
Tensor<T> policy_loss(Tape<T>& tape, Pair<T>& critics, Sample<T> sample, T alpha) {
    return combine(tape, alpha, mean(tape, sample.log_prob), T(-1), mean(tape, least_q(tape, critics, sample.pairs)));
}

// SAC eq. (18), with log alpha for alpha, as rlkit: J(alpha) = mean (-log alpha (log pi(a | s) + target_entropy)).
// Returns J and adds its gradient to that of log alpha; the policy gets none.
template <class T>
T temperature_loss(Parameter<T>& log_alpha, Tensor<T> log_prob, T target_entropy) {
    T slope = 0;
    for (ptrdiff_t i = 0; i < log_prob.rows; ++i) slope -= (log_prob.value[i] + target_entropy) / T(log_prob.rows);
    log_alpha.gradient[0] += slope;
    return slope * log_alpha.value[0];
}

// SAC algorithm 1: target = (1 - rate) target + rate value.
inline void soft_update(std::vector<float>& target, const std::vector<float>& value, float rate) {
    vectorised<float>([&](auto) INLINE_LAMBDA {
        for (size_t i = 0; i < target.size(); ++i) target[i] = (1 - rate) * target[i] + rate * value[i];
    });
}

// ---------------------------------------------------------------------------------------------------------------------
// Acting.

using ActionAndLogProb = std::pair<std::vector<float>, float>;  // [A]; D4RL's infos/action_log_probs

// The policy's action at a state [S]. noise [A]: standard normal, or zeros for the mean action. The tape is emptied and
// stops recording.
inline ActionAndLogProb act(Tape<float>& tape, Network<float>& policy, const float* state,
                            const std::vector<float>& noise) {
    tape.reset();
    tape.recording = false;
    const Tensor<float> states = tape.constant(state, 1, policy.inputs());
    const Sample<float> sample = draw(tape, states, forward(tape, policy, states), noise.data());
    const float* values = sample.pairs.value + policy.inputs();
    return {{values, values + noise.size()}, sample.log_prob.value[0]};
}

// The same with the noise of a time-step of an episode.
inline ActionAndLogProb act_sampled(Tape<float>& tape, Network<float>& policy, const float* state, uint32_t seed,
                                    uint64_t episode, uint32_t t) {
    std::vector<float> noise(policy.outputs() / 2);
    for (uint32_t i = 0; i < noise.size(); ++i) noise[i] = Random{seed, Stream::exploration}.normal(episode, t, i);
    return act(tape, policy, state, noise);
}

// Plays an episode with sampled actions, and appends their log-probabilities to `log_probs` if it is given.
inline Episode play_sampled(Tape<float>& tape, Network<float>& policy, Environment& environment, uint32_t seed,
                            uint64_t number, std::vector<float>* log_probs = nullptr) {
    return play(environment, {seed, Stream::environment}, number, [&](const Episode& episode) {
        const int t = episode.trajectory.length();
        const auto [action, log_prob] = act_sampled(tape, policy, episode.state.data(), seed, number, t);
        if (log_probs) log_probs->push_back(log_prob);
        return action;
    });
}

// ---------------------------------------------------------------------------------------------------------------------
// The learner.

struct Progress {
    uint64_t steps = 0, updates = 0, episodes = 0;  // steps of the environment; finished episodes
    uint64_t episode_steps = 0;                     // of the present episode so far
};

struct Learner {
    Settings settings;
    EnvironmentSpec spec;
    Tape<float> learning, acting;

    // The state of the run, all of it saved by visit(). The environment's own state is not: resume() restores it.
    Progress progress;
    std::vector<float> state = std::vector<float>(spec.state_dim);                  // of the environment
    Network<float> policy = network(spec.state_dim, 2 * spec.action_dim, 1e-3, 0);  // m, then l
    Pair<float> critics{critic(6), critic(12)}, targets = critics;
    std::vector<Parameter<float>> log_alpha{{"log_alpha", {1}, {0.0f}, {0.0f}}};  // one; alpha starts at 1
    Optimizer policy_optimizer, alpha_optimizer;
    std::array<Optimizer, 2> critic_optimizers;
    Replay replay{spec.state_dim, spec.action_dim, settings.capacity};

    Network<float> network(int in, int out, double last_range, uint64_t first_tensor) const {
        return Network<float>(in, settings.hidden, out, last_range, settings.seed, first_tensor);
    }
    Network<float> critic(uint64_t first_tensor) const {
        return network(spec.state_dim + spec.action_dim, 1, 3e-3, first_tensor);
    }

    // Errors: sac.settings.
    Learner(const Settings& s, const EnvironmentSpec& e, Compute& compute)
        : settings(s),
          spec(e),
          learning(compute),
          acting(compute) {
        const bool holds_an_episode = s.capacity >= static_cast<uint64_t>(e.max_episode_steps);
        require(e.discrete_actions == 0 && holds_an_episode && s.batch >= 1 && s.steps_per_update >= 1, "sac.settings",
                "SAC needs continuous actions, batch and steps_per_update of at least 1, and a replay of an episode, ",
                e.max_episode_steps, " steps, or more");
        replay.rows.reserve(s.capacity * replay.width());  // address space; the system gives memory at the first write
    }

    // One step of the environment, then an update at every steps_per_update-th step after the random ones.
    void step(Environment& environment) {
        interact(environment);
        const bool due = progress.steps > settings.random_steps && progress.steps % settings.steps_per_update == 0;
        if (due && replay.size() > 0) update();
    }

    // One step of the environment into the replay. play() of memory.hpp would not do: updates come between the steps of
    // an episode, and a checkpoint may be written between any two. A broken-down simulation cuts the episode.
    void interact(Environment& environment) {
        Progress& p = progress;
        if (p.episode_steps == 0)
            environment.reset(Random{settings.seed, Stream::environment}, p.episodes, state.data());
        const Random random{settings.seed, Stream::exploration};
        const uint32_t t = static_cast<uint32_t>(p.episode_steps);
        std::vector<float> action(spec.action_dim), next_state(state.size());
        if (p.steps >= settings.random_steps)
            action = act_sampled(acting, policy, state.data(), settings.seed, p.episodes, t).first;
        else
            for (uint32_t i = 0; i < action.size(); ++i)
                action[i] = static_cast<float>(2 * random.uniform(p.episodes, t, i) - 1);
        ++p.steps;
        End end = End::cut;
        try {
            const Step result = environment.step(action.data(), next_state.data());
            ++p.episode_steps;
            const bool at_limit = p.episode_steps >= static_cast<uint64_t>(spec.max_episode_steps);
            end = result.terminated ? End::terminated : at_limit ? End::cut : End::none;
            replay.add(state.data(), action.data(), result.reward, end, next_state.data(), p.episodes);
            state = next_state;
        } catch (const Error& error) {
            if (error.id != "environment.unstable") throw;
            if (p.episode_steps > 0) replay.cut_last();
        }
        if (end == End::none) return;
        p.episode_steps = 0;
        ++p.episodes;
    }

    // SAC algorithm 1, in rlkit's order: first the temperature, then all networks, each with gradients at the old ones.
    // Returns the losses of critics and policy.
    std::pair<float, float> update() {
        const Random rows{settings.seed, Stream::batch}, normals{settings.seed, Stream::entropy_noise};
        const uint64_t number = progress.updates++;
        const size_t A = spec.action_dim, n = settings.batch;
        std::vector<float> noise(2 * n * A);
        for (size_t i = 0; i < noise.size(); ++i)
            noise[i] = normals.normal(number, static_cast<uint32_t>(i / A % n),
                                      static_cast<uint32_t>(i % A + (i < n * A ? 0 : A)));
        learning.reset();
        Tape<float>& tape = learning;
        const Batch<float> batch =
            gather(tape, replay, settings.batch, [&](uint32_t i) { return rows.below(replay.size(), number, i); });
        const Sample<float> sample = draw(tape, batch.states, forward(tape, policy, batch.states), noise.data());
        temperature_loss(log_alpha[0], sample.log_prob, -static_cast<float>(spec.action_dim));
        adam(log_alpha, alpha_optimizer);
        const float alpha = std::exp(log_alpha[0].value[0]);
        const float* target = q_target(tape, policy, targets, batch, noise.data() + n * A, alpha, settings);
        const Tensor<float> critic = critic_loss(tape, critics, batch, target),
                            actor = policy_loss(tape, critics, sample, alpha);
        tape.backward(combine(tape, 1.0f, critic, 1.0f, actor));  // the two losses share no parameter
        adam(policy.parameters, policy_optimizer);
        for (size_t k = 0; k < 2; ++k) {
            adam(critics[k].parameters, critic_optimizers[k]);
            for (size_t i = 0; i < critics[k].parameters.size(); ++i)
                soft_update(targets[k].parameters[i].value, critics[k].parameters[i].value,
                            static_cast<float>(settings.target_rate));
        }
        return {critic.value[0], actor.value[0]};
    }

    void adam(std::vector<Parameter<float>>& parameters, Optimizer& optimizer) {
        update_parameters(learning.compute, parameters, optimizer,
                          {.rule = OptimizerConfig::Rule::adamw,  // without decay: Adam
                           .learning_rate = settings.learning_rate,
                           .clip_norm = 0,
                           .warmup_updates = 0});
    }

    // Brings an environment to the state of a loaded run, by repeating the present episode's actions, which the replay
    // holds. Errors: sac.resume.
    void resume(Environment& environment) {
        std::vector<float> found = state;
        if (progress.episode_steps > 0)
            environment.reset(Random{settings.seed, Stream::environment}, progress.episodes, found.data());
        for (uint64_t back = progress.episode_steps; back > 0; --back)
            environment.step(replay.action(replay.recent(back)), found.data());
        require(found == state, "sac.resume", "the present episode (", progress.episodes,
                ") went another way; resume on the machine that began it");
    }

    void visit(auto& archive) {
        archive("progress.steps", progress.steps);
        archive("progress.updates", progress.updates);
        archive("progress.episodes", progress.episodes);
        archive("progress.episode_steps", progress.episode_steps);
        archive("state", state);
        visit_trained(archive, "policy", policy.parameters, policy_optimizer);
        visit_trained(archive, "temperature", log_alpha, alpha_optimizer);
        for (size_t k = 0; k < 2; ++k) {
            const std::string number = std::to_string(k);
            visit_trained(archive, "critic" + number, critics[k].parameters, critic_optimizers[k]);
            for (Parameter<float>& parameter : targets[k].parameters)
                archive("target" + number + "." + parameter.name, parameter.value);
        }
        replay.visit(archive);
        require(progress.episode_steps <= replay.size(), "checkpoint.shape", "an episode of ", progress.episode_steps,
                " steps is not in the replay");
    }
};

// ---------------------------------------------------------------------------------------------------------------------
// Files: a checkpoint is the whole state; a policy has the names and shapes of D4RL's metadata/policy.

// What must agree between a checkpoint and the run that loads it, on one line. `note`: a text of the caller's, the
// task's name for instance.
inline std::string settings_text(const Learner& learner, const std::string& note) {
    const Settings& s = learner.settings;
    char text[400];
    std::snprintf(text, sizeof text,
                  "seed=%u hidden=%d batch=%d capacity=%llu random_steps=%llu steps_per_update=%llu "
                  "learning_rate=%.17g discount=%.17g target_rate=%.17g reward_scale=%.17g state_dim=%d "
                  "action_dim=%d max_episode_steps=%d kernel=%s ",
                  s.seed, s.hidden, s.batch, static_cast<unsigned long long>(s.capacity),
                  static_cast<unsigned long long>(s.random_steps), static_cast<unsigned long long>(s.steps_per_update),
                  s.learning_rate, s.discount, s.target_rate, s.reward_scale, learner.spec.state_dim,
                  learner.spec.action_dim, learner.spec.max_episode_steps,
                  learner.learning.compute.kernel.arithmetic());
    return text + note;
}

inline void save_checkpoint(const std::string& path, Learner& learner, const std::string& note) {
    TensorFile file;
    file.metadata["format"] = "wodtem sac checkpoint 2";
    file.metadata["settings"] = settings_text(learner, note);
    file.buffer.reserve(learner.replay.rows.size() * sizeof(float) + (16 << 20));
    Saver saver{file};
    learner.visit(saver);
    write_safetensors(path, file);
}

// Call resume() afterwards. Errors: sac.checkpoint, checkpoint.shape, file.*, safetensors.*; the learner may then hold
// half of the checkpoint and must be dropped.
inline void load_checkpoint(const std::string& path, Learner& learner, const std::string& note) {
    const TensorFile file = read_own_safetensors(path);
    require(file.text("format") == "wodtem sac checkpoint 2", "sac.checkpoint", path,
            ": is not a SAC checkpoint of this version; remove it to train anew");
    const std::string found = file.text("settings"), wanted = settings_text(learner, note);
    require(found == wanted, "sac.checkpoint", path, ": was made with ", found, ", this run has ", wanted);
    Loader loader{file};
    learner.visit(loader);
}

// Calls f(name, shape, values) for fc0.weight [256, S], fc0.bias, fc1.*, last_fc.* [A, 256] (the means) and
// last_fc_log_std.*: D4RL's names and PyTorch's layout. `parameters` may be const.
void each_policy_tensor(auto& parameters, auto&& f) {
    for (size_t i = 0; i < 4; ++i) f(parameters[i].name, parameters[i].shape, std::span(parameters[i].value));
    for (size_t half = 0; half < 2; ++half)
        for (size_t i = 4; i < 6; ++i) {
            Shape shape = parameters[i].shape;
            shape[0] /= 2;
            const size_t size = parameters[i].value.size() / 2;
            f((half == 0 ? "last_fc" : "last_fc_log_std") + parameters[i].name.substr(7), shape,
              std::span(parameters[i].value).subspan(half * size, size));
        }
}

// metadata: the name, the return and so on.
inline void save_policy(const std::string& path, const Network<float>& policy,
                        const std::map<std::string, std::string>& metadata = {}) {
    TensorFile file;
    file.metadata = metadata;
    file.metadata["nonlinearity"] = "relu";
    file.metadata["output_distribution"] = "tanh_gaussian";
    each_policy_tensor(policy.parameters, [&](const std::string& name, const Shape& shape, auto values) {
        file.add(name, shape, values);
    });
    write_safetensors(path, file);
}

// The policy that save_policy() wrote. Errors: sac.policy, safetensors.*
inline Network<float> policy_of(const TensorFile& file) {
    const Shape first = file.find("fc0.weight").shape, last = file.find("last_fc.weight").shape;
    const auto fits = [](uint64_t extent) { return extent >= 1 && extent <= 1 << 14; };
    const bool tables = first.size() == 2 && last.size() == 2;
    require(tables && fits(first[0]) && fits(first[1]) && fits(last[0]), "sac.policy", file.path, ": fc0.weight ",
            shape_text(first), " and last_fc.weight ", shape_text(last), " are not those of a policy");
    Network<float> policy(first[1], first[0], 2 * last[0], 1, 0, 0);
    each_policy_tensor(policy.parameters, [&](const std::string& name, const Shape& shape, auto values) {
        file.read_into(values, name, shape);
    });
    return policy;
}

}  // namespace sac
