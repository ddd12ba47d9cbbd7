// wodtem.cpp: the method: weighting online decision transformer with episodic memory.
//
//   State       Normaliser, Temperature, Agent, Run              what a run is, all of it
//   Batches     sample_batch, consult_memory                     sec. III-B, IV-B.2, eqs. (5) to (7)
//   Learning    objective, update, update_lambda                 eqs. (1) to (3) and (8) to (10)
//   Acting      acting_batch, choose_action, rollout, evaluate   sec. III-B
//   Phases      offline_phase, interact, online_phase            sec. III-B, IV-B.3
//   Commands    one function for each, their table, main
//
// One code path serves three methods. DT has the first term of the objective alone, offline (for continuous actions the
// squared error instead of the likelihood); ODT adds the entropy constraint and the online phase; WODTEM adds the
// memory, and with alpha = 1 it is ODT bit for bit.
// "Step 1" to "step 5" of sec. IV-B.3 is our numbering of what that section does in turn; the paper numbers nothing.
// Names: theta is Agent::model, lambda Agent::temperature, Q Run::memory, D Run::replay; a_c, g_c, d_c, s_c are action,
// return-to-go, discounted return and state of step c of a window; a-hat and w come from the memory.
// Promises: on one machine a run is a function of its settings: the same bytes for any number of threads, in one go or
// continued.
// Leaves out: files, text and pictures (data/); networks in general (nn.hpp); the table itself (memory.hpp).

#include "gridworld.hpp"
#include "memory.hpp"
#include "mujoco_env.hpp"
#include "nn.hpp"
// What follows is compiled quickly: files, words, and the method itself, whose loops take little of an update.
#pragma GCC optimize("O1")
#include "data/collect.hpp"
#include "data/command_line.hpp"
#include "data/console.hpp"
#include "data/d4rl.hpp"
#include "data/info.hpp"
#include "data/model_file.hpp"
#include "data/report.hpp"
#include "data/run_folder.hpp"
#include "data/settings.hpp"
#include "data/state.hpp"
#include "tests/trace.hpp"

// ---------------------------------------------------------------------------------------------------------------------
// State. Everything that changes during a run lies in plain structs, so that a checkpoint can list it. S and A stand
// for state_dim and action_dim, T for the steps of a trajectory, n for the steps of a batch.

// States reach the network as (s - mean) / deviation, per dimension.
struct Normaliser {
    std::vector<float> mean, deviation;  // [state_dim] over all offline states; constant during a run
};

// ODT's code: the population standard deviation plus 1e-6. The trajectory that offline_set() drops is included.
Normaliser fit_normaliser(const std::vector<Trajectory>& trajectories, int state_dim) {
    Normaliser normaliser;
    for (int i = 0; i < state_dim; ++i) {
        // Two passes in double: the mean first, then the squares of what differs from it.
        double count = 0, sum = 0, squares = 0;
        const auto for_each_value = [&](auto&& f) {
            for (const Trajectory& trajectory : trajectories)
                for (size_t at = i; at < trajectory.states.size(); at += state_dim) f(trajectory.states[at]);
        };
        for_each_value([&](float x) {
            sum += x;
            count += 1;
        });
        const double mean = sum / count;
        for_each_value([&](float x) { squares += (x - mean) * (x - mean); });
        normaliser.mean.push_back(static_cast<float>(mean));
        normaliser.deviation.push_back(static_cast<float>(std::sqrt(squares / count) + 1e-6));
    }
    return normaliser;
}

// The Lagrange multiplier of eqs. (1) and (8), stored as its logarithm, so that lambda > 0 by construction, and the
// state of its Adam.
struct Temperature {
    std::vector<Parameter<float>> log_lambda;  // one parameter [1]
    Optimizer optimizer;
    explicit Temperature(double initial_lambda)
        : log_lambda{{"log_temperature", {1}, {std::log(static_cast<float>(initial_lambda))}, {0}}} {}
    float lambda() const { return std::exp(log_lambda[0].value[0]); }
};

// What acts, and all that a model file holds. Every random number of a run is a function of (seed, stream, step,
// index): nothing about random numbers has to be stored.
struct Agent {
    Settings settings;
    EnvironmentSpec spec;
    Transformer<float> model;  // theta
    Normaliser normaliser;
    Temperature temperature;  // lambda

    Agent(const Settings& s, const EnvironmentSpec& e)
        : settings(s),
          spec(e),
          model(transformer_config(s, e), static_cast<uint32_t>(s.seed)),
          temperature(s.initial_lambda) {}

    bool discrete() const { return spec.discrete_actions > 0; }
    bool uses_memory() const { return settings.method == "wodtem"; }
    bool constrains_entropy() const { return settings.method != "dt"; }
    // The random numbers of one use; the tables of streams are in memory.hpp and nn.hpp.
    Random random(uint32_t stream) const { return {static_cast<uint32_t>(settings.seed), stream}; }
};

// The agent as model_file.hpp reads and writes it.
ModelContents contents_of(Agent& agent) {
    return {agent.settings,        agent.model.config,        agent.model.parameters, agent.temperature.log_lambda[0],
            agent.normaliser.mean, agent.normaliser.deviation};
}

// How far a run has come.
struct Progress {
    uint64_t updates = 0, interactions = 0, episodes = 0;  // interactions: steps of the online phase
    uint64_t online = 0;                                   // 1 in the online phase
    uint64_t evaluations = 0, next_evaluation = 0;         // next_evaluation: at this number of episodes
    double eval_length = NAN, eval_return = NAN;           // of the latest evaluation
};

// Everything that a run needs. The first block is its state; a checkpoint holds exactly that.
struct Run {
    Agent agent;
    Optimizer optimizer;    // of theta
    ReplayBuffer replay;    // D_offline in the offline phase, D_online afterwards
    EpisodicMemory memory;  // Q
    Progress progress;
    Tally tally;  // sums for the log

    // Not state: threads and kernel, scratch memory, environments (each episode begins with a reset).
    Compute& compute;
    Tape<float> learning, acting;  // scratch memory of the two passes
    Environments environments;     // as many as an evaluation plays side by side

    Run(Compute& c, const Settings& settings, const Environment& environment)
        : agent(settings, environment.spec()),
          replay{agent.spec.state_dim, agent.spec.action_dim, settings.gamma,
                 static_cast<size_t>(settings.buffer_size)},
          memory(memory_config(settings, agent.spec), static_cast<uint32_t>(settings.seed)),
          compute(c),
          learning(c),
          acting(c),
          environments(environment, settings.eval_episodes) {
        acting.recording = false;
    }
};

// Names every part of the state once; saving and loading call it with their archive, which writes a field under its
// name or reads it back. Errors of loading: checkpoint.entry, safetensors.*.
template <class Archive>
void visit_state(Archive& archive, Run& run) {
    Progress& p = run.progress;
    archive("progress.updates", p.updates);
    archive("progress.interactions", p.interactions);
    archive("progress.episodes", p.episodes);
    archive("progress.online", p.online);
    archive("progress.evaluations", p.evaluations);
    archive("progress.next_evaluation", p.next_evaluation);
    archive("progress.eval_length", p.eval_length);
    archive("progress.eval_return", p.eval_return);
    run.tally.visit(archive);
    run.tally.advice_shift.resize(run.agent.model.config.action_dim);
    archive("progress.advice_shift", run.tally.advice_shift);
    visit_trained(archive, "model", run.agent.model.parameters, run.optimizer);
    visit_trained(archive, "temperature", run.agent.temperature.log_lambda, run.agent.temperature.optimizer);
    const size_t state_dim = run.agent.spec.state_dim;  // which loading demands of these two
    archive("normaliser.mean", run.agent.normaliser.mean, state_dim);
    archive("normaliser.deviation", run.agent.normaliser.deviation, state_dim);
    if (archive.loading) check_state(run);
    const int moves = run.agent.spec.discrete_actions;
    if (p.online != 0) visit_replay(archive, run.replay, moves);  // in the offline phase it is the data set
    visit_memory(archive, run.memory, moves);
}

// ---------------------------------------------------------------------------------------------------------------------
// Batches: from trajectories to what the network reads. Raw states index the memory; the network sees normalised ones.
// What the memory adds to a batch, weights and advised actions, is constant in the backward pass.

// to [state_dim] = s [state_dim], normalised.
void normalise(float* to, const Normaliser& normaliser, const float* state) {
    for (size_t i = 0; i < normaliser.mean.size(); ++i)
        to[i] = (state[i] - normaliser.mean[i]) / normaliser.deviation[i];
}

// Brings an action into the open interval (-1, 1), because atanh(1) is infinite. ODT's code.
float clamp_action(float a) { return std::clamp(a, -1.0f + 1e-6f, 1.0f - 1e-6f); }

// An action as it enters a token: to [discrete_actions], one-hot, or to [action_dim], clamped.
void write_action_token(float* to, const EnvironmentSpec& spec, const float* action) {
    for (int i = 0; i < spec.discrete_actions; ++i) to[i] = *action == static_cast<float>(i) ? 1.0f : 0.0f;
    for (int i = 0; spec.discrete_actions == 0 && i < spec.action_dim; ++i) to[i] = clamp_action(action[i]);
}

// An action as the likelihood takes it: to [action_dim], an index, or clamped.
void write_action(float* to, const EnvironmentSpec& spec, const float* action) {
    for (int i = 0; i < spec.action_dim; ++i) to[i] = spec.discrete_actions > 0 ? action[i] : clamp_action(action[i]);
}

// Writes what the memory knows a state by, both [state_dim]: the state itself, or normalised (setting keys).
void write_memory_key(float* to, const Agent& agent, const float* state) {
    if (agent.settings.keys == "normalized")
        normalise(to, agent.normaliser, state);
    else
        std::copy_n(state, agent.spec.state_dim, to);
}

// Some windows of an update's batch: n steps, packed. c runs over the steps of a window, which are C^t of eqs. (2) and
// (9). The paper makes of one sub-trajectory samples (s^c, g^c) of 1 to |C^t| steps. Attention is causal, so one pass
// over the window gives pi(. | s^c, g^c) for all c at once: what stands behind step c does not enter it.
// departs from ODT's code: packed, not padded on the left to context_length, so that no mask is needed.
struct Batch {
    SequenceBatch sequences;
    std::vector<float> actions;              // [n, action_dim] a_c
    std::vector<float> advised_actions;      // [n, action_dim] a-hat(s_c)
    std::vector<double> discounted_returns;  // [n] d_c
    std::vector<float> keys;                 // [n, state_dim] what the memory knows s_c by
    std::vector<double> coefficients;        // [n] 1 / (batch_size |C^t|): the mean over a window's steps, then windows
    std::vector<float> weights;              // [n] w(s_c, a_c)
    std::vector<uint32_t> random_index;      // [n] window * context_length + step: index of a step's random numbers
    Neighbourhoods neighbours;               // [n] K(s_c)
    double short_pairs = 0;                  // steps with d_c < e-hat
};

// Writes step t of a relabelled trajectory as step i. g_t and d_t run to the trajectory's end, not the window's.
void write_step(Batch& batch, size_t i, const Agent& agent, const Trajectory& trajectory, int t) {
    const int S = agent.spec.state_dim, A = agent.spec.action_dim;
    const float *state = &trajectory.states[t * S], *action = &trajectory.actions[t * A];
    // The network reads g_t times reward_scale. d_t stays in units of the reward: eqs. (5) and (7) compare it
    // with e, which is a d_t too, and eq. (6) takes exp(e) as it is.
    const double g = trajectory.returns_to_go[t] * agent.settings.reward_scale;
    batch.sequences.returns_to_go[i] = static_cast<float>(g);
    normalise(&batch.sequences.states[i * S], agent.normaliser, state);
    write_action_token(&batch.sequences.actions[i * agent.model.config.action_dim], agent.spec, action);
    batch.sequences.timesteps[i] = t;
    write_action(&batch.actions[i * A], agent.spec, action);
    batch.discounted_returns[i] = trajectory.discounted_returns[t];
    write_memory_key(&batch.keys[i * S], agent, state);
}

// The batch of these windows; coefficients, weights, advised_actions, random_index and neighbours stay empty.
Batch batch_of(const Agent& agent, const std::vector<Trajectory>& trajectories, std::span<const Window> windows) {
    Batch batch;
    size_t n = 0, i = 0;
    for (const Window& window : windows) {
        n += batch.sequences.lengths.emplace_back(window.length);
        // The data lie anywhere in memory. Fetched now, those of all windows arrive at the same time.
        const Trajectory& trajectory = trajectories[window.trajectory];
        __builtin_prefetch(&trajectory.states[window.start * agent.spec.state_dim]);
        __builtin_prefetch(&trajectory.actions[window.start * agent.spec.action_dim]);
        __builtin_prefetch(&trajectory.returns_to_go[window.start]);
        __builtin_prefetch(&trajectory.discounted_returns[window.start]);
    }
    batch.sequences.resize(n, agent.spec.state_dim, agent.model.config.action_dim);
    batch.actions.resize(n * agent.spec.action_dim);
    batch.discounted_returns.resize(n);
    batch.keys.resize(n * agent.spec.state_dim);
    for (const Window& window : windows)
        for (int c = 0; c < window.length; ++c)
            write_step(batch, i++, agent, trajectories[window.trajectory], window.start + c);
    return batch;
}

// WODTEM sec. IV-B.3, step 1: sub-trajectories (s_{-C,t}, a_{-C,t}, g_{-C,t}, d_{-C,t}) from the replay buffer: windows
// [first, end) of this update's batch, all weights 1.
Batch sample_batch(const Run& run, uint32_t first, uint32_t end) {
    const Agent& agent = run.agent;
    const uint32_t context_length = static_cast<uint32_t>(agent.settings.context_length);
    const Sampling sampling = agent.settings.sampling == "uniform" ? Sampling::uniform : Sampling::by_length;
    std::vector<Window> windows;
    for (uint32_t window = first; window < end; ++window)
        windows.push_back(run.replay.sample(agent.random(Stream::batch), run.progress.updates, window,
                                            static_cast<int>(context_length), sampling));
    Batch batch = batch_of(agent, run.replay.trajectories, windows);
    for (uint32_t window = first; window < end; ++window)
        for (int c = 0, length = windows[window - first].length; c < length; ++c) {
            batch.coefficients.push_back(1.0 / static_cast<double>(agent.settings.batch_size * length));
            batch.random_index.push_back(window * context_length + static_cast<uint32_t>(c));
        }
    // Without a memory, or where it has nothing better: w = 1, and a-hat, whose weight is then 0, is a_c.
    batch.advised_actions = batch.actions;
    batch.weights.assign(batch.coefficients.size(), 1.0f);
    return batch;
}

// WODTEM sec. IV-B.3, step 2: looks up each s_c in Q; weighs (s_c, a_c) by eq. (7) and, where it falls short, draws
// a-hat(s_c) by eq. (6), anew in each batch. A state without a neighbour has w = 1: there is nothing to compare with.
// Changes the batch alone; the caller hands it to count_lookups() when all parts of the update have looked up.
void consult_memory(const Run& run, Batch& batch) {
    const Agent& agent = run.agent;
    if (!agent.uses_memory()) return;
    const Random random = agent.random(Stream::advised_action);
    batch.neighbours = run.memory.search(batch.keys.data(), batch.weights.size());
    for (size_t i = 0; i < batch.weights.size(); ++i) {
        const std::span<const Neighbour> found = batch.neighbours[i];
        // Q has taken in all of D, this step too. So, unless the table has forgotten it or exclude_self is set, s_c is
        // as a rule its own first neighbour, at distance 0, and has e >= d_c there.
        const bool optimal = run.memory.is_optimal(found, batch.discounted_returns[i]);  // eq. (5)
        batch.weights[i] = static_cast<float>(EpisodicMemory::weight(optimal, agent.settings.alpha));
        if (optimal) continue;
        batch.short_pairs += 1;
        const double uniform = random.uniform(run.progress.updates, batch.random_index[i]);
        const float* advised = run.memory.advised_action(found, uniform);  // eq. (6)
        write_action(&batch.advised_actions[i * agent.spec.action_dim], agent.spec, advised);
    }
}

// What a batch's look-ups change in the run: accesses and sums. Counting accesses changes no distance, so it can wait
// until all parts of an update have looked up.
void count_lookups(Run& run, const Batch& batch) {
    for (size_t i = 0; i < batch.neighbours.size(); ++i) {
        run.memory.count_accesses(batch.neighbours[i]);  // every neighbour counts, whether or not it is followed
        run.tally.unmatched_pairs += batch.neighbours[i].empty();
        if (batch.weights[i] == 1) continue;
        const size_t first = i * run.agent.spec.action_dim;
        add_advice(run.tally, run.agent.spec, batch.coefficients[i] * (1.0 - batch.weights[i]), &batch.actions[first],
                   &batch.advised_actions[first]);
    }
    run.tally.pairs += static_cast<double>(batch.neighbours.size());
    run.tally.short_pairs += batch.short_pairs;
}

// WODTEM sec. IV-B.1: the table takes in a trajectory by eq. (4), once, as soon as the trajectory is complete.
void remember(Run& run, const Trajectory& trajectory) {
    if (!run.agent.uses_memory()) return;
    Trajectory keyed = trajectory;
    const int S = run.agent.spec.state_dim;
    for (int t = 0; t < trajectory.length(); ++t)
        write_memory_key(&keyed.states[t * S], run.agent, &trajectory.states[t * S]);
    const EpisodicMemory::Changes changes = run.memory.update(keyed);
    run.tally.matched += static_cast<double>(changes.improved + changes.kept);
    run.tally.evicted += static_cast<double>(changes.evicted);
}

// ---------------------------------------------------------------------------------------------------------------------
// Learning. One forward pass gives the policy pi(. | s^c, g^c) at every step of the batch; L, H-bar and their gradients
// come from that pass; theta descends and lambda ascends the same Lagrangian, one step each.

// The terms of eq. (8) for a batch, or a part's share of them.
template <class T>
struct Objective {
    Tensor<T> L;           // [1, 1] L(theta), which is J(theta) where all w = 1
    Tensor<T> H;           // [1, 1] H-bar(theta); absent for DT
    Tensor<T> lagrangian;  // [1, 1] what theta descends
};

// Eqs. (2), (3) and (8) to (10) for one batch, or for its windows' share of them. entropy_noise [n, action_dim]:
// standard normals, for the Gaussian head only.
template <class T>
Objective<T> objective(Tape<T>& tape, const Policy<T>& policy, const Batch& batch, const float* entropy_noise,
                       std::type_identity_t<T> lambda, bool constrain_entropy) {
    // A sum with these coefficients is the expectation over windows of the mean over a window's steps.
    const size_t n = batch.coefficients.size();
    const std::vector<T> mean(batch.coefficients.begin(), batch.coefficients.end());
    std::vector<T> observed(n), advised(n);  // [n] coefficients of log pi(a_c | ...) and log pi(a-hat | ...)
    for (size_t i = 0; i < n; ++i) {
        const T w = batch.weights[i];
        observed[i] = -mean[i] * w;
        advised[i] = -mean[i] * (T(1) - w);
    }
    Objective<T> result;
    // WODTEM eq. (9): L = E[ -1/|C^t| sum_c w log pi(a_c | s^c, g^c) - 1/|C^t| sum_c (1 - w) log pi(a-hat | s^c, g^c) ]
    // WODTEM eq. (2): J is L with w = 1. Both terms read one distribution; the action tokens stay the buffer's.
    // departs from ODT's code: the mean runs over a window's steps, then over windows, as written; not over all steps.
    // log_prob: [n, 1], the logarithm of a probability, or for continuous actions of a density (it may be above 0).
    result.L = combine(tape, T(1), weighted_sum(tape, log_prob(tape, policy, batch.actions.data()), observed.data()),
                       T(1), weighted_sum(tape, log_prob(tape, policy, batch.advised_actions.data()), advised.data()));
    if (!constrain_entropy) {
        result.lagrangian = result.L;
        return result;
    }
    // WODTEM eq. (3); WODTEM eq. (10): H-bar = E[ 1/|C^t| sum_c H(pi(. | s^c, g^c)) ]
    // departs from ODT's code: over real steps only, as written; there padding enters this mean.
    result.H = weighted_sum(tape, entropy(tape, policy, entropy_noise), mean.data());
    // WODTEM eq. (1); WODTEM eq. (8): L + lambda (eta - H-bar), which theta descends: lambda eta does not depend on it.
    result.lagrangian = combine(tape, T(1), result.L, -lambda, result.H);
    return result;
}

// Dual ascent on lambda, eqs. (1) and (8): lambda ascends lambda (eta - H-bar), by one step of Adam on log lambda. By
// the chain rule the gradient with respect to log lambda is lambda (eta - H-bar) as well; Adam descends, hence the
// sign. So lambda grows while the policy's entropy is below eta, and shrinks towards 0 while it is above. entropy:
// H-bar of the same batch, in nats per step. ODT's code: learning rate 1e-4, no decay, no clipping, no warm-up.
void update_lambda(Compute& compute, Temperature& temperature, const Settings& settings, double entropy) {
    const OptimizerConfig adam{.rule = OptimizerConfig::Rule::adamw,
                               .learning_rate = settings.lambda_learning_rate,
                               .weight_decay = 0,
                               .clip_norm = 0,
                               .warmup_updates = 0};
    temperature.log_lambda[0].gradient[0] = static_cast<float>(-temperature.lambda() * (settings.eta - entropy));
    update_parameters(compute, temperature.log_lambda, temperature.optimizer, adam);
}

// Standard normals for the one-sample entropy of the Gaussian head, [n, action_dim]; none for another head. The index
// of a step does not depend on the part of the batch that it is in.
std::vector<float> entropy_noise(const Run& run, const Batch& batch) {
    if (run.agent.model.config.head != Head::squashed_gaussian) return {};
    const int dim = run.agent.spec.action_dim, n = static_cast<int>(batch.random_index.size());
    const Random random = run.agent.random(Stream::entropy_noise);
    std::vector<float> noise(batch.actions.size());
    for_rows(run.compute, n, 100 * dim, [&](int begin, int end, int) {
        for (int i = begin * dim; i < end * dim; ++i)
            noise[i] = random.normal(run.progress.updates, batch.random_index[i / dim], static_cast<uint32_t>(i % dim));
    });
    return noise;
}

// A batch is computed in parts of about 2048 tokens, so that activations stay in the cache and take little memory. The
// split depends on the settings alone, never on threads.
uint32_t parts_of_batch(const Settings& settings) {
    const int64_t windows = std::max<int64_t>(1, 2048 / (3 * settings.context_length));
    return static_cast<uint32_t>(divide_up(settings.batch_size, windows));
}

// One update on one batch. WODTEM sec. IV-B.3, step 3: "alternately optimizing" eq. (8): a step of theta, then one of
// lambda, with the entropy of the same pass. Errors: nn.not_finite; nn.stopped, where nothing but gradients, which are
// no state, has changed.
void update(Run& run) {
    Agent& agent = run.agent;
    Tape<float>& tape = run.learning;
    const uint32_t windows = static_cast<uint32_t>(agent.settings.batch_size), parts = parts_of_batch(agent.settings);
    double loss = 0, entropy = 0;  // L and H-bar of the whole batch: each part adds its windows' share
    std::vector<Batch> batches;    // [parts]
    {
        const FrozenWeights frozen(run.compute);  // theta stands still until all parts are done
        for (uint32_t part = 0; part < parts; ++part) {
            tape.reset();
            tape.part = part;  // each part draws dropout masks of its own, and each update new ones
            tape.dropout_random = agent.random(Stream::dropout);
            tape.dropout_step = run.progress.updates;
            Batch& batch =
                batches.emplace_back(sample_batch(run, windows * part / parts, windows * (part + 1) / parts));
            consult_memory(run, batch);
            const std::vector<float> noise = entropy_noise(run, batch);
            const Policy<float> policy = forward(tape, agent.model, batch.sequences, Queries::every_state);
            const Objective<float> result =
                objective(tape, policy, batch, noise.data(), agent.temperature.lambda(), agent.constrains_entropy());
            tape.backward(result.lagrangian);  // adds to the gradients of theta
            loss += result.L.value[0];
            if (agent.constrains_entropy()) entropy += result.H.value[0];
        }
    }
    // Before anything is changed: a run stops at its last sound state.
    if (!std::isfinite(loss + entropy))
        fail("nn.not_finite", "the loss (%g) or the entropy (%g) is not finite", loss, entropy);
    // Eq. (8), theta: gradient descent (LAMB, or AdamW for DT), after which the gradients are zero again.
    const double gradient_norm =
        update_parameters(run.compute, agent.model.parameters, run.optimizer, optimizer_config(agent.settings));
    for (const Batch& batch : batches) count_lookups(run, batch);
    // Eq. (8), lambda: gradient ascent.
    if (agent.constrains_entropy()) update_lambda(run.compute, agent.temperature, agent.settings, entropy);
    if (!std::isfinite(agent.temperature.lambda())) fail("nn.not_finite", "lambda is not finite");
    run.tally.loss += loss;
    run.tally.entropy += entropy;
    run.tally.gradient_norm += gradient_norm;
    run.tally.updates += 1;
    run.progress.updates += 1;
}

// ---------------------------------------------------------------------------------------------------------------------
// Acting, sec. III-B. The agent is given a target return. In each step it sees the latest steps of its episode, each
// with what is left of the target, and the network's last state token predicts the action.

enum class Act { sample, greedy };  // online interaction; evaluation

// The argmax of log_p [count]; of equal ones the first.
int most_likely_action(const float* log_p, int count) {
    return static_cast<int>(std::max_element(log_p, log_p + count) - log_p);
}

// Inverse CDF: the action whose share of [0, 1) contains `uniform`. log_p [count]. Where rounding leaves a gap below 1,
// it belongs to the last action.
int sampled_action(const float* log_p, int count, double uniform) {
    for (int action = 0; action + 1 < count; ++action) {
        uniform -= static_cast<double>(std::exp(log_p[action]));
        if (uniform < 0) return action;
    }
    return count - 1;
}

// The action [action_dim] of one row of the policy, as it is stored and given to the environment. policy.output [rows,
// columns]: log-probabilities of the discrete_actions, or one value per action dimension. random: one stream, one
// number per dimension, at (episode, t). Sec. III-B: evaluation takes "the mean vector" or "the maximum probability";
// with a Gaussian under tanh that is tanh of its mean, as in ODT's code.
std::vector<float> choose_action(const Agent& agent, const Policy<float>& policy, int row, Act act,
                                 const Random& random, uint64_t episode, uint32_t t) {
    const int columns = policy.output.columns, first = row * columns;
    const float* output = policy.output.value + first;
    if (agent.discrete()) {
        const int action = act == Act::greedy ? most_likely_action(output, columns)
                                              : sampled_action(output, columns, random.uniform(episode, t));
        return {static_cast<float>(action)};
    }
    // Gaussian: a = tanh(u), u = mean or mean + std * noise. Deterministic: the head's output is the action.
    const bool gaussian = agent.model.config.head == Head::squashed_gaussian;
    std::vector<float> action;
    for (int i = 0; i < columns; ++i) {
        float u = output[i];
        if (gaussian && act == Act::sample)
            u += std::exp(policy.log_std.value[first + i]) * random.normal(episode, t, static_cast<uint32_t>(i));
        action.push_back(clamp_action(gaussian ? std::tanh(u) : u));
    }
    return action;
}

// The sliding context: the latest min(eval_context, context_length) steps of each episode, packed, the present state
// last. A step keeps its time-step and the return-to-go that it was given when it was made. The present step has no
// action yet; its token is never built.
SequenceBatch acting_batch(const Agent& agent, std::span<Episode* const> running) {
    const int context = static_cast<int>(std::min(agent.settings.eval_context, agent.settings.context_length));
    const int S = agent.spec.state_dim, A = agent.spec.action_dim, token = agent.model.config.action_dim;
    const std::vector<float> no_action(A);
    SequenceBatch batch;
    size_t n = 0, i = 0;
    for (const Episode* episode : running)
        n += batch.lengths.emplace_back(std::min(context, episode->trajectory.length() + 1));
    batch.resize(n, S, token);
    for (const Episode* episode : running) {
        const Trajectory& past = episode->trajectory;
        const int t = past.length();
        for (int c = std::max(0, t + 1 - context); c <= t; ++c, ++i) {
            const float* action = c < t ? &past.actions[c * A] : no_action.data();
            normalise(&batch.states[i * S], agent.normaliser, c < t ? &past.states[c * S] : episode->state.data());
            write_action_token(&batch.actions[i * token], agent.spec, action);
            batch.returns_to_go[i] = episode->targets[c];
            batch.timesteps[i] = c;
        }
    }
    return batch;
}

// Appends the return-to-go that the agent is given at the present step, scaled as in training. It may become negative
// or exceed what can be reached; it is not clipped. target: g_1, unscaled.
void append_target(Episode& episode, double target, double reward_scale) {
    if (episode.targets.empty())
        episode.targets.push_back(static_cast<float>(target * reward_scale));  // g_1
    else  // WODTEM sec. III-B, g_{t+1}: g_{t+1} = g_t - r_t
        episode.targets.push_back(episode.targets.back() - static_cast<float>(episode.reward * reward_scale));
}

// Plays one episode in each environment, numbered from `first` on, through the network as one batch, and computes its
// returns in hindsight. Sec. III-B: g_1 = target; a_t from the policy: sampled, or its mean or argmax.
// acting: a tape that does not record, so that there is neither gradient nor dropout. Errors: nn.stopped,
// memory.not_finite, and what reset() and step() throw but environment.unstable.
std::vector<Episode> rollout(const Agent& agent, Tape<float>& acting, std::span<Environment* const> environments,
                             Act act, double target, uint64_t first) {
    const FrozenWeights frozen(acting.compute);  // theta stands still during the rollout
    const Random random = agent.random(Stream::exploration);
    // All episodes stand at the same time-step; those that are over are no longer in the batch.
    const auto choose = [&](std::span<Episode* const> running) {
        for (Episode* episode : running) append_target(*episode, target, agent.settings.reward_scale);
        acting.reset();
        const SequenceBatch batch = acting_batch(agent, running);
        const Policy<float> policy = forward(acting, agent.model, batch, Queries::last_state);
        std::vector<float> actions;
        for (size_t i = 0; i < running.size(); ++i) {
            const uint32_t t = static_cast<uint32_t>(running[i]->trajectory.length());
            const std::vector<float> action =
                choose_action(agent, policy, static_cast<int>(i), act, random, running[i]->number, t);
            actions.insert(actions.end(), action.begin(), action.end());
        }
        return actions;
    };
    std::vector<Episode> episodes =
        play(environments, agent.random(Stream::environment), first, choose, &acting.compute.threads);
    for (Episode& episode : episodes)
        relabel(episode.trajectory, agent.spec.state_dim, agent.spec.action_dim, agent.settings.gamma);
    return episodes;
}

// A number decides all chance of its episode: online episodes count from 0, evaluations from here, data sets from
// data_set_episodes. So the number of evaluations does not move the online episodes' random numbers.
constexpr uint64_t evaluation_episodes = uint64_t{1} << 40;  // the number of the first evaluation's first episode

// The episodes of one evaluation, and their means.
struct Evaluation {
    double mean_length = NAN, mean_return = NAN;  // of the episodes without an error
    std::vector<Episode> episodes;
};

// Sec. III-B: the mean (or the most probable action) of the policy, g_1 = g_eval. first: the number of its first
// episode among those of all evaluations of the run.
Evaluation evaluate(const Agent& agent, Tape<float>& acting, std::span<Environment* const> environments,
                    uint64_t first) {
    Evaluation result;
    result.episodes =
        rollout(agent, acting, environments, Act::greedy, agent.settings.g_eval, evaluation_episodes + first);
    // Undiscounted returns, as D4RL's scores are defined; episodes whose simulation broke down do not count.
    double length = 0, total = 0, count = 0;
    for (const Episode& episode : result.episodes) {
        if (!episode.error.empty()) continue;
        length += episode.trajectory.length();
        total += total_return(episode.trajectory);
        count += 1;
    }
    if (count == 0) return result;
    result.mean_length = length / count;  // one division: the mean of equal lengths is exact
    result.mean_return = total / count;
    return result;
}

// ---------------------------------------------------------------------------------------------------------------------
// The two phases. They can be left and entered again after any update and any episode: what remains to be done follows
// from the state alone.

// Whom the phases inform: files, console and checkpoints stand behind these functions. Nothing that an observer does
// affects what is computed.
struct Observer {
    std::function<void(const ProgressRow&, const Evaluation&)> evaluated;
    std::function<void(const EpisodeRow&)> played;    // an online episode
    std::function<void(const std::string&)> dropped;  // an episode whose simulation broke down; the sentence
    std::function<void()> ending = [] {};     // before the last evaluation: a larger budget would go on from here
    std::function<void(double share)> pause;  // after each update and episode, when the state is complete: a checkpoint
                                              // may be saved, and an error thrown to stop. share: of the phase's work
};

// An episode whose simulation broke down is reported, counted, and used for nothing.
void count_dropped(Run& run, const Observer& observer, const std::vector<Episode>& episodes, const char* kind) {
    for (const Episode& episode : episodes) {
        if (episode.error.empty()) continue;
        run.tally.dropped += 1;
        observer.dropped(std::string(kind) + " episode is dropped: " + episode.error);
    }
}

// What there is to report of a run: its counts, its latest evaluation, and the sums since the evaluation before.
ProgressRow progress_row(const Run& run) {
    const Settings& settings = run.agent.settings;
    const Progress& p = run.progress;
    // The learning rate of the latest update; before the first one, of the first.
    const uint64_t latest_update = std::max<uint64_t>(1, p.updates) - 1;
    const double warmup = warmup_factor(latest_update, static_cast<uint64_t>(settings.warmup_updates));
    return {p.online != 0,
            p.updates,
            p.interactions,
            p.episodes,
            settings.learning_rate * warmup,
            run.agent.constrains_entropy() ? run.agent.temperature.lambda() : NAN,
            run.memory.size(),
            p.eval_length,
            p.eval_return,
            score_of(settings, p.eval_return),
            run.tally};
}

// Evaluates the policy, reports the evaluation with the sums since the one before, and clears the sums.
void evaluate_and_report(Run& run, const Observer& observer) {
    Progress& p = run.progress;
    const uint64_t first = p.evaluations * static_cast<uint64_t>(run.agent.settings.eval_episodes);
    const Evaluation evaluation = evaluate(run.agent, run.acting, run.environments.all(), first);
    count_dropped(run, observer, evaluation.episodes, "an evaluation");
    p.eval_length = evaluation.mean_length;
    p.eval_return = evaluation.mean_return;
    observer.evaluated(progress_row(run), evaluation);
    p.evaluations += 1;
    p.next_evaluation = p.episodes + static_cast<uint64_t>(run.agent.settings.eval_every);
    run.tally = {};
}

// WODTEM sec. IV-B.3, step 4: offline training (fig. 2) on D_offline, all of which the table has taken in before
// (begin_run). It continues at whatever update the run has reached, and ends with an evaluation.
void offline_phase(Run& run, const Observer& observer) {
    const uint64_t updates = static_cast<uint64_t>(run.agent.settings.offline_updates);
    while (run.progress.updates < updates) {
        update(run);
        observer.pause(static_cast<double>(run.progress.updates) / static_cast<double>(updates));
    }
    if (run.agent.settings.online_steps == 0) observer.ending();
    evaluate_and_report(run, observer);
}

// One online episode. Sec. III-B: its returns-to-go are computed in hindsight from its rewards (relabel, in rollout).
// It enters D_online, and at once the table, before the updates that follow it.
void interact(Run& run, const Observer& observer) {
    Progress& p = run.progress;
    std::vector<Episode> episodes =
        rollout(run.agent, run.acting, run.environments.first(), Act::sample, run.agent.settings.g_online, p.episodes);
    Trajectory& trajectory = episodes[0].trajectory;
    // Steps count as interactions also where the simulation broke down afterwards: they were made.
    p.episodes += 1;
    p.interactions += static_cast<uint64_t>(trajectory.length());
    count_dropped(run, observer, episodes, "an online");
    if (!episodes[0].error.empty()) return;
    run.tally.rollouts += 1;
    run.tally.rollout_length += trajectory.length();
    run.tally.rollout_return += total_return(trajectory);
    observer.played({p.episodes, p.interactions, trajectory, run.agent.discrete()});
    // The table before the buffer: `add` takes the trajectory.
    remember(run, trajectory);
    run.replay.add(std::move(trajectory));
}

// WODTEM sec. IV-B.3, step 5: online fine-tuning (fig. 2) on D_online, which begins with the best trajectories of
// D_offline. Each iteration: one episode, then updates_per_iteration updates; every eval_every iterations an
// evaluation. The paper's budget is online_steps, in steps of the environment; updates are not counted by it.
void online_phase(Run& run, const Observer& observer) {
    const Settings& settings = run.agent.settings;
    Progress& p = run.progress;
    if (p.online == 0) {  // D_online: the buffer_size trajectories of D_offline with the highest returns
        run.replay.capacity = static_cast<size_t>(settings.buffer_size);
        run.replay.start(std::move(run.replay.trajectories));
        p.online = 1;
    }
    const uint64_t budget = static_cast<uint64_t>(settings.online_steps);
    while (true) {
        const double share = std::min(1.0, static_cast<double>(p.interactions) / static_cast<double>(budget));
        // The updates that belong to the offline phase and to the episodes so far. After an interruption some of them
        // may still be missing; they are made before anything else.
        const uint64_t due = static_cast<uint64_t>(settings.offline_updates) +
                             p.episodes * static_cast<uint64_t>(settings.updates_per_iteration);
        while (p.updates < due) {
            update(run);
            observer.pause(std::min(share, 0.999));
        }
        // The last evaluation follows the last episode's updates; that episode may exceed the budget by its length.
        const bool last = p.interactions >= budget;
        if (last) observer.ending();
        if (p.episodes >= p.next_evaluation || last) evaluate_and_report(run, observer);
        if (last) return;
        interact(run, observer);
        observer.pause(std::min(share, 0.999));
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// Where a run begins: the environment, the data, and the state before the first update.

// Makes `data_set` the replay buffer's D_offline: the buffer is as large as the set, and nothing is overwritten.
void start_offline(Run& run, std::vector<Trajectory> data_set) {
    run.replay.capacity = data_set.size();
    run.replay.start(std::move(data_set));
}

// D_offline, the statistics of its states, and the first contents of the table, in the order of the data set. A given
// model brings its own statistics, which are those that its network was trained with.
void begin_run(Run& run, std::vector<Trajectory> data_set) {
    const Settings& settings = run.agent.settings;
    run.agent.normaliser = fit_normaliser(data_set, run.agent.spec.state_dim);
    if (!settings.weights_path.empty()) {
        ModelContents contents = contents_of(run.agent);
        load_first_weights(contents, open_model(settings.weights_path));
    }
    // The table takes in what the buffer holds: not the trajectory that ODT's code drops.
    data_set = offline_set(std::move(data_set), settings.keep_lowest);
    for (const Trajectory& trajectory : data_set) remember(run, trajectory);
    start_offline(run, std::move(data_set));
}

// Continues from the folder's checkpoint, or begins anew, without logs. Returns whether there was a checkpoint. Errors:
// checkpoint.*, run.*, file.*, those of the data set.
bool begin_or_continue(Run& run, RunFolder& folder) {
    const Settings& settings = run.agent.settings;
    const bool resumed = folder.has("checkpoint.safetensors");
    if (resumed)
        load_checkpoint(folder, settings, [&](auto& archive) { visit_state(archive, run); });
    else
        begin_run(run, make_data_set(settings));
    if (resumed && run.progress.online == 0)  // the checkpoint does not hold the data set
        start_offline(run, offline_set(make_data_set(settings), settings.keep_lowest));
    return resumed;
}

// What trains on a file alone, acts on lines of text and asks the policy for figures, by the functions above.
#include "data/grid_results.hpp"
#include "data/own_data.hpp"

// ---------------------------------------------------------------------------------------------------------------------
// Training in a folder: the phases above, with the run folder and the console as their observer.

// Options of train() that change no number of the run.
struct TrainOptions {
    const Kernel& kernel;
    int threads = 1;
    double checkpoint_every = 30;  // seconds; when a checkpoint is saved decides nothing but what a kill costs
    bool keep_state = false;       // of a finished run, so that it can go on with a larger budget
    std::string label = "";        // begins each line of progress
    double later_updates = 0;      // of the runs that follow this one, for the time left
    std::function<bool()> asked_to_stop = [] { return stop_requested != 0; };
};

// Saves the checkpoints of a run when they are due, and shows how far it is. When that happens changes no result.
struct Watcher {
    Run& run;
    RunFolder& folder;
    const TrainOptions& options;
    Console console{.label = options.label};
    CheckpointTimer timer{options.checkpoint_every};
    Clock::time_point began = Clock::now();
    uint64_t first_update = run.progress.updates;

    void save() {
        save_checkpoint(folder, run.agent.settings, [&](auto& archive) { visit_state(archive, run); });
    }

    // Errors: run.stopped after a checkpoint that was saved because the user asked to stop; file.*.
    void save_if_due() {
        const bool stop = options.asked_to_stop();
        if (!stop && !timer.due()) return;
        timer.time([&] { save(); });
        if (!stop) return;
        console.end_line();
        fail("run.stopped", "stopped after update %llu; everything is saved in %s, and the same command continues",
             static_cast<unsigned long long>(run.progress.updates), folder.path.c_str());
    }

    // The time left is that of this phase, by its share, and of all later phases and runs, by their expected updates.
    void show(double share) {
        const Settings& settings = run.agent.settings;
        const double updates = static_cast<double>(run.progress.updates - first_update);
        const double rate = std::max(1.0, updates) / std::max(1e-3, seconds_since(began));  // updates a second
        const bool online = run.progress.online != 0;
        double later = options.later_updates;
        if (!online) later += expected_updates(settings) - static_cast<double>(settings.offline_updates);
        console.show(online ? "online" : "offline", share, later / rate,
                     [&] { return status_text(progress_row(run), rate); });
    }
};

// Trains in a folder of its own, which may hold a part of this very run: claims the folder, begins or continues the
// run, goes through its phases, and saves the model. Errors: run.*, nn.not_finite, file.*, and those of the data set.
void train(const Settings& settings, const std::string& path, const TrainOptions& options) {
    const FolderLock lock(path);
    RunFolder folder{path};
    claim_folder(folder, settings);
    if (is_finished_already(folder, options.keep_state)) return;
    Compute compute(options.kernel, options.threads);
    std::optional<StopAtOnce> drawing_and_reading(std::in_place);  // which may take long
    if (options.asked_to_stop()) fail("run.stopped", "%s", nothing_to_save.data());
    Run run(compute, settings, *make_environment(settings));
    const bool had_log = folder.has("progress.csv"), resumed = begin_or_continue(run, folder);
    drawing_and_reading.reset();
    describe_run(folder, settings);
    if (resumed || had_log) print_continuation(path, resumed, run.progress.updates);
    if (!resumed) folder.begin_logs(settings);
    SecondsLog seconds{folder.file("seconds.csv"), machine_text(options.kernel, options.threads)};
    seconds.begin(resumed, run.progress.updates, run.progress.interactions);

    // Each event of the run has its row in a log; rows come before the checkpoint that counts them.
    Watcher watcher{run, folder, options};
    compute.asked_to_stop = options.asked_to_stop;
    Observer observer;
    observer.evaluated = [&](const ProgressRow& row, const Evaluation& evaluation) {
        save_maze_paths(folder, evaluation.episodes, run.environments.all());
        folder.progress.append(progress_line(row, settings));
        seconds.append(row.updates, row.interactions);
    };
    observer.played = [&](const EpisodeRow& row) { folder.episodes.append(episode_line(row, settings)); };
    observer.dropped = [](const std::string& sentence) { std::fprintf(stderr, "wodtem: %s\n", sentence.c_str()); };
    if (options.keep_state) observer.ending = [&] { watcher.save(); };
    observer.pause = [&](double share) {
        watcher.save_if_due();
        watcher.show(share);
    };
    try {
        if (settings.task == own_data)
            fit_own_data(run, observer, path);
        else if (run.progress.online == 0)
            offline_phase(run, observer);
        if (settings.online_steps > 0) online_phase(run, observer);
    } catch (const Error& error) {
        if (error.id == "nn.stopped") watcher.save_if_due();  // which ends in run.stopped
        if (error.id != "nn.not_finite") throw;
        fail(error.id.c_str(), "update %llu of %s: %s; the run stops here, its last checkpoint is kept",
             static_cast<unsigned long long>(run.progress.updates + 1), path.c_str(), error.what());
    }
    watcher.show(1);

    // The mark that the run is finished comes after everything that it promises, and the checkpoint goes last.
    folder.sync_logs();
    ModelContents contents = contents_of(run.agent);
    contents.updates = run.progress.updates;
    contents.interactions = run.progress.interactions;
    contents.evaluations = run.progress.evaluations;
    save_model(contents, folder.file("model.safetensors"));
    if (settings.task == "gridworld") save_grid_results(run, folder);
    write_file_atomic(folder.file("finished"), "");
    retire_checkpoint(folder, options.keep_state);
    if (settings.task != own_data) print_end(path, progress_row(run), settings);
}

// ---------------------------------------------------------------------------------------------------------------------
// The commands: from arguments to one call each. What they print is worded in data/.

// All runs are checked before the first one begins; each continues what its folder already holds.
void command_train(const Arguments& arguments) {
    stop_on_signals();
    const std::vector<PlannedRun> runs = planned_runs(arguments);
    const int64_t seconds = whole_number(arguments["--checkpoint-every"], "--checkpoint-every", 0, 86400);
    std::vector<double> updates;  // expected of each run
    for (const PlannedRun& run : runs) updates.push_back(expected_updates(run.settings));
    for (size_t i = 0; i < runs.size(); ++i) {
        announce(runs[i]);
        const int threads = arguments["--threads"] == "0" ? default_threads(runs[i].settings) : thread_count(arguments);
        TrainOptions options{kernel_of(arguments), threads, static_cast<double>(seconds), arguments.has("--keep-state"),
                             runs[i].label};
        for (size_t later = i + 1; later < runs.size(); ++later) options.later_updates += updates[later];
        train(runs[i].settings, runs[i].folder, options);
    }
}

// Without --seed: the run's last evaluation again.
void command_eval(const Arguments& arguments) {
    Actor actor(arguments);
    const Settings& settings = actor.settings;
    const uint64_t first =
        arguments.has("--seed") ? 0 : first_of_last_evaluation(actor.contents, settings_in(actor.file));
    const Environments environments(*make_environment(settings), settings.eval_episodes);
    const Evaluation evaluation = evaluate(actor.agent, actor.acting, environments.all(), first);
    print_evaluation(settings, evaluation.episodes, evaluation.mean_length, evaluation.mean_return);
    if (arguments.has("--record")) write_episodes(arguments["--record"], evaluation.episodes, actor.agent.discrete());
}

void command_act(const Arguments& arguments) {
    Actor actor(arguments);
    act_on_lines(actor.agent, actor.acting, arguments.words.size() > 1 ? arguments.words[1] : "");
}

// From a model to ODT's code, and back.
void command_export(const Arguments& arguments) {
    if (!arguments.has("--odt")) fail("usage.option", "export knows one layout; ask for it with --odt");
    export_odt(arguments.words[0], arguments.words[1]);
}

void command_import(const Arguments& arguments) {
    const TensorFile file = read_safetensors(arguments.words[0]);
    const Settings settings = imported_settings(arguments, file);
    import_odt(file, settings, arguments.words[1], [&](StoredModel& model) {
        const Normaliser normaliser = fit_normaliser(make_data_set(settings), model.spec.state_dim);
        model.state_mean = normaliser.mean;
        model.state_std = normaliser.deviation;
    });
}

// Without --steps as many rows as D4RL's data set has.
void command_collect(const Arguments& arguments) {
    const std::string& steps = arguments["--steps"];
    collect(full_task_name(arguments.words[0]), arguments["--out"],
            steps.empty() ? 0 : whole_number(steps, "--steps", 1, 100000000),
            whole_number(arguments["--seed"], "--seed", 0, 2147483647), arguments["--policy"], thread_count(arguments));
}

// Without a task the list of tasks; with one its settings.
void command_tasks(const Arguments& arguments) {
    if (arguments.words.empty()) return print_tasks();
    print_settings(arguments);
}

// The verdict is the last thing printed.
void command_report(const Arguments& arguments) {
    const std::string text = report(arguments.words, arguments["--out"]);
    std::printf("report: %s/report.html\n%s", arguments["--out"].c_str(), text.c_str());
}

// `bench` and `check` measure and judge the functions above, so they are included behind them.
#include "tests/bench.hpp"
#include "tests/check.hpp"

// With --estimate each method's update is timed on this machine first.
void command_sweep(const Arguments& arguments) {
    const std::vector<Settings> sweep = swept_settings(arguments);
    const Kernel& kernel = kernel_of(arguments);
    double seconds = 0;
    if (arguments.has("--estimate"))
        for (const Settings& settings : sweep) seconds += estimated_seconds(settings, kernel);
    print_sweep(sweep, arguments, seconds);
}

const Command commands[] = {
    {"train", "TASK|FILE", 1, 1, "offline phase, online phase, evaluations; continues what is there", command_train,
     settings_help},
    {"eval", "MODEL", 1, 1, "evaluate a saved model; needs nothing else", command_eval},
    {"act", "MODEL [FILE]", 1, 2, "actions of a saved model for states that are given line by line", command_act,
     act_help},
    {"export", "MODEL OUT", 2, 2, "write a model's weights for another program", command_export},
    {"import", "FILE OUT", 2, 2, "make a model of weights under ODT's names, in a safetensors file", command_import},
    {"collect", "ID", 1, 1, "make a stand-in for one of D4RL's data sets, in its layout", command_collect,
     collect_help},
    {"trace", "TASK", 1, 1, "step a MuJoCo task from given states through given actions, to 17 digits",
     [](const Arguments& a) { trace_task(a.words[0], a["--physics"]); }, trace_help},
    {"report", "DIR...", 1, 10000, "tables and figures of runs, or of all in a folder: HTML, SVG, Markdown",
     command_report},
    {"sweep", "[TASK]", 0, 1, "print one train command per method and seed, for any job runner", command_sweep},
    {"info", "FILE", 1, 1, "what is in a data set, a model or a checkpoint, and what it means",
     [](const Arguments& a) { print_info(a.words[0], a["--task"]); }},
    {"bench", "[WHAT]", 0, 1,
     "updates: kernels and updates beside the machine's peaks, look-ups; environments: steps a second; random-policy",
     command_bench},
    {"check", "FILE...", 0, 10000, "recompute golden vectors, ours or yours, and compare", command_check},
    {"tasks", "[TASK|FILE]", 0, 1, "list tasks, or the settings of one with their sources", command_tasks},
};

#ifndef WODTEM_NO_MAIN
int main(int argument_count, char** arguments) {
    return run_program(commands, {arguments + 1, arguments + argument_count});
}
#endif
