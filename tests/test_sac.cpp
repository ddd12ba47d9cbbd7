// test_sac.cpp: data/sac.hpp against finite differences, plain loops, closed forms and tasks whose best return is
// known.
//
// In order: replay; the policy's distribution; the losses and the target; learning; stopping and resuming; files.
#include <unistd.h>

#include <filesystem>
#include <functional>
#include <span>
#include <string>
#include <vector>

#include "../data/sac.hpp"
#include "../mujoco_env.hpp"
#include "plain.hpp"
#include "test.hpp"

namespace {

Compute& one_thread() {
    static Compute compute(best_kernel(), 1);
    return compute;
}

// A path of this process alone, removed at the end.
struct TemporaryFile {
    std::string path;
    explicit TemporaryFile(const std::string& name)
        : path(std::filesystem::temp_directory_path() / ("wodtem-sac-" + std::to_string(getpid()) + "-" + name)) {}
    ~TemporaryFile() { std::filesystem::remove(path); }
};

// Numbers of one test, a function of test_seed() and the test's own number.
struct Draws {
    uint64_t test;
    uint32_t count = 0;
    float normal() { return Random{test_seed(), Stream::data_set}.normal(test, count++); }
    std::vector<float> normals(size_t n) {
        std::vector<float> x(n);
        for (float& value : x) value = normal();
        return x;
    }
};

// The network in plain loops: what the file's names and shapes promise.
template <class T>
std::vector<double> plain_forward(const sac::Network<T>& network, std::vector<double> x) {
    for (size_t layer = 0; layer < 3; ++layer) {
        const std::vector<T>&w = network.parameters[2 * layer].value, &b = network.parameters[2 * layer + 1].value;
        std::vector<double> y(b.begin(), b.end());
        for (size_t i = 0; i < y.size(); ++i) {
            for (size_t j = 0; j < x.size(); ++j) y[i] += static_cast<double>(w[i * x.size() + j]) * x[j];
            if (layer < 2) y[i] = std::max(y[i], 0.0);
        }
        x = y;
    }
    return x;
}

// Three state and two action dimensions, seven transitions, one of them terminal and one cut, and tiny networks whose
// outputs are of order one.
struct Tiny {
    sac::Replay replay{3, 2, 100};
    sac::Network<double> policy{3, 6, 4, 0.7, test_seed(), 0};
    sac::Pair<double> critics{sac::Network<double>(5, 6, 1, 0.7, test_seed(), 10),
                              sac::Network<double>(5, 6, 1, 0.7, test_seed(), 20)};
    sac::Pair<double> targets{sac::Network<double>(5, 6, 1, 0.7, test_seed(), 30),
                              sac::Network<double>(5, 6, 1, 0.7, test_seed(), 40)};
    std::vector<float> noise, next_noise;  // [7, 2]
    static constexpr int rows = 7;

    Tiny() {
        Draws draws{1};
        for (int i = 0; i < rows; ++i) {
            const auto state = draws.normals(3), next_state = draws.normals(3);
            const std::vector<float> action = {std::tanh(draws.normal()), std::tanh(draws.normal())};
            const sac::End end = i == 2 ? sac::End::terminated : i == 4 ? sac::End::cut : sac::End::none;
            replay.add(state.data(), action.data(), draws.normal(), end, next_state.data(), 0);
        }
        noise = draws.normals(2 * rows);
        next_noise = draws.normals(2 * rows);
    }
    sac::Batch<double> batch(Tape<double>& tape) const {
        return sac::gather(tape, replay, rows, [](uint32_t i) { return size_t{i}; });
    }
    sac::Sample<double> sample(Tape<double>& tape, Tensor<double> states) {
        return sac::draw(tape, states, sac::forward(tape, policy, states), noise.data());
    }
};

using Loss = std::function<Tensor<double>(Tape<double>&)>;

// The gradient of `loss` with respect to every element of `leaves` against central differences of fourth order; where a
// ReLU or a minimum bends between the points a smaller step decides. Relative to the element or 1/100 of the largest.
void check_gradients(const char* what, const Loss& loss, const std::vector<Parameter<double>*>& leaves) {
    Tape<double> tape(one_thread());
    for (Parameter<double>* x : leaves) x->gradient.assign(x->value.size(), 0.0);
    tape.backward(loss(tape));
    double overall = 0;
    for (Parameter<double>* x : leaves)
        for (const double g : x->gradient) overall = std::max(overall, std::fabs(g));
    CHECK(overall > 1e-3);
    for (Parameter<double>* x : leaves)
        for (size_t i = 0; i < x->value.size(); ++i) {
            const double start = x->value[i], g = x->gradient[i];
            const auto at = [&](double moved) {
                x->value[i] = start + moved;
                tape.reset();
                return loss(tape).value[0];
            };
            double error = 1;
            for (double h = 1e-3; h > 1e-6 && error > 1e-8; h /= 8) {
                const double slope = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h);
                error = std::min(error, std::fabs(slope - g) / std::max(std::fabs(g), overall / 100));
            }
            x->value[i] = start;
            if (!(error < 1e-6))
                report_failure(__FILE__, __LINE__,
                               std::string(what) + ", " + x->name + "[" + shown(i) + "]: gradient " + shown(g) +
                                   " differs from central differences by a relative " + shown(error));
        }
}

std::vector<Parameter<double>*> leaves_of(std::initializer_list<sac::Network<double>*> networks) {
    std::vector<Parameter<double>*> leaves;
    for (sac::Network<double>* network : networks)
        for (Parameter<double>& parameter : network->parameters) leaves.push_back(&parameter);
    return leaves;
}

}  // namespace

// ---------------------------------------------------------------------------------------------------------------------
// Replay

TEST(sac_replay_is_a_ring_that_keeps_the_newest) {
    sac::Replay replay{2, 1, 4};
    for (int i = 0; i < 6; ++i) {
        const float x = static_cast<float>(i), state[2] = {x, -x}, next_state[2] = {x + 0.5f, -x - 0.5f};
        replay.add(state, &x, 10 * i, i == 3 ? sac::End::terminated : sac::End::none, next_state,
                   static_cast<uint64_t>(100 + i / 4));
        CHECK_EQUAL(replay.size(), static_cast<size_t>(std::min(i + 1, 4)));
        CHECK_EQUAL(replay.row(replay.recent(1))[0], x);
    }
    CHECK_EQUAL(replay.recent(4), size_t{2});  // the oldest that is left, number 2, and the row to go next
    CHECK_EQUAL(replay.next, uint64_t{2});
    for (uint64_t back = 1; back <= 4; ++back) {
        const size_t row = replay.recent(back);
        const float x = static_cast<float>(6 - back);
        CHECK_EQUAL(replay.row(row)[1], -x);
        CHECK_EQUAL(replay.action(row)[0], x);
        CHECK_EQUAL(replay.reward(row), 10 * x);
        CHECK_EQUAL(replay.next_state(row)[1], -x - 0.5f);
        CHECK_EQUAL(replay.episode(row), x < 4 ? uint64_t{100} : uint64_t{101});
        CHECK(replay.end(row) == (x == 3 ? sac::End::terminated : sac::End::none));
    }
    replay.cut_last();
    CHECK(replay.end(replay.recent(1)) == sac::End::cut);
    CHECK(replay.end(replay.recent(2)) == sac::End::none);
}

// ---------------------------------------------------------------------------------------------------------------------
// The policy's distribution

// With u = mean + std z running over z in [-9, 9], the trapezoids under exp(log pi(a)) over a = tanh(u).
TEST(sac_density_of_actions_integrates_to_one) {
    const double settings[][2] = {{0, 0}, {0.8, -1.5}, {-1.2, 0.4}, {2.5, -3}, {0, 0.7}};  // mean, log std
    for (const auto& [mean, log_std] : settings) {
        constexpr int n = 40001;
        Tape<double> tape(one_thread());
        const Tensor<double> output = tape.make(n, 2);
        std::vector<float> noise;
        for (ptrdiff_t i = 0; i < n; ++i) {
            output.value[2 * i] = mean;
            output.value[2 * i + 1] = log_std;
            noise.push_back(static_cast<float>(-9 + 18.0 * static_cast<double>(i) / (n - 1)));
        }
        tape.recording = false;
        const sac::Sample<double> sample = sac::draw(tape, {}, output, noise.data());
        double integral = 0;
        for (ptrdiff_t i = 1; i < n; ++i)
            integral += (sample.pairs.value[i] - sample.pairs.value[i - 1]) *
                        (std::exp(sample.log_prob.value[i]) + std::exp(sample.log_prob.value[i - 1])) / 2;
        CHECK_CLOSE(integral, 1, 2e-5);
    }
}

TEST(sac_log_probability_agrees_with_the_density_of_a_given_action) {
    constexpr int n = 50;
    Draws draws{2};
    Tape<double> tape(one_thread());
    const Tensor<double> output = tape.make(n, 6);
    for (size_t i = 0; i < output.size(); ++i)
        output.value[i] = 0.4 * static_cast<double>(draws.normal()) - (i % 6 < 3 ? 0 : 1);
    const auto noise = draws.normals(3 * n);
    tape.recording = false;
    const sac::Sample<double> sample = sac::draw(tape, {}, output, noise.data());
    for (ptrdiff_t i = 0; i < n; ++i) {
        double expected = 0;
        for (ptrdiff_t j = 0; j < 3; ++j) {
            const double a = sample.pairs.value[3 * i + j], std = std::exp(output.value[6 * i + 3 + j]),
                         z = (std::atanh(a) - output.value[6 * i + j]) / std;
            expected += -z * z / 2 - std::log(std) - half_log_2_pi - std::log(1 - a * a);
        }
        CHECK_CLOSE(sample.log_prob.value[i], expected, 1e-7);
    }
}

TEST(sac_standard_deviations_are_clamped_and_the_extremes_are_finite) {
    Tape<float> tape(one_thread());
    const float outputs[] = {0.5f, -30, 0.5f, 5, 40, 2, -40, -20}, noise[] = {1, 1, 1, -1};
    Tensor<float> output = tape.make(4, 2);
    std::copy_n(outputs, 8, output.value);
    const sac::Sample<float> sample = sac::draw(tape, {}, output, noise);
    CHECK_CLOSE(sample.pairs.value[0], std::tanh(0.5), 1e-6);  // std exp(-20)
    CHECK_CLOSE(sample.pairs.value[1], std::tanh(0.5 + std::exp(2)), 1e-6);
    CHECK_EQUAL(sample.pairs.value[2], 1.0f);
    CHECK_EQUAL(sample.pairs.value[3], -1.0f);
    const float ones[] = {1, 1, 1, 1};
    tape.backward(weighted_sum(tape, sample.log_prob, ones));
    for (size_t i = 0; i < 8; ++i) CHECK(std::isfinite(output.grad()[i]));
    for (size_t i = 0; i < 4; ++i) CHECK(std::isfinite(sample.log_prob.value[i]));
    CHECK_EQUAL(output.grad()[1], 0.0f);  // outside the clamp
    CHECK_EQUAL(output.grad()[3], 0.0f);
    CHECK(output.grad()[5] != 0 && output.grad()[7] != 0);  // on its edges
}

// ---------------------------------------------------------------------------------------------------------------------
// The losses and the target

TEST(sac_gradient_of_the_critic_loss_equals_central_differences) {
    Tiny tiny;
    const Loss loss = [&](Tape<double>& tape) {
        const auto batch = tiny.batch(tape);
        return sac::critic_loss(tape, tiny.critics, batch,
                                sac::q_target(tape, tiny.policy, tiny.targets, batch, tiny.next_noise.data(), 0.3, {}));
    };
    check_gradients("critic loss", loss, leaves_of({&tiny.critics[0], &tiny.critics[1]}));
    for (const Parameter<double>* x : leaves_of({&tiny.policy, &tiny.targets[0], &tiny.targets[1]}))
        for (const double g : x->gradient) CHECK_EQUAL(g, 0.0);  // the target is no function to be learned
}

TEST(sac_gradient_of_the_policy_loss_equals_central_differences) {
    Tiny tiny;
    const Loss loss = [&](Tape<double>& tape) {
        const auto batch = tiny.batch(tape);
        return sac::policy_loss(tape, tiny.critics, tiny.sample(tape, batch.states), 0.3);
    };
    Tape<double> tape(one_thread());
    const auto sample = tiny.sample(tape, tiny.batch(tape).states);
    std::vector<double> q0, excess;  // of the first critic over the second
    for (size_t i = 0; i < Tiny::rows; ++i) {
        const std::vector<double> x(sample.pairs.value + 5 * i, sample.pairs.value + 5 * (i + 1));
        CHECK(std::equal(x.begin(), x.begin() + 3, tiny.replay.row(i)));
        q0.push_back(plain_forward(tiny.critics[0], x)[0]);
        excess.push_back(q0.back() - plain_forward(tiny.critics[1], x)[0]);
    }
    std::vector<double> sorted = excess;  // moved so that each critic gives the minimum somewhere
    std::sort(sorted.begin(), sorted.end());
    const double shift = (sorted[3] + sorted[4]) / 2;
    tiny.critics[1].parameters[5].value[0] += shift;
    double expected = 0;
    for (size_t i = 0; i < Tiny::rows; ++i)
        expected += (0.3 * sample.log_prob.value[i] - (q0[i] - std::max(excess[i] - shift, 0.0))) / Tiny::rows;

    check_gradients("policy loss", loss, leaves_of({&tiny.policy}));
    for (const Parameter<double>* x : leaves_of({&tiny.critics[0], &tiny.critics[1]}))
        for (const double g : x->gradient) CHECK_EQUAL(g, 0.0);
    tape.reset();
    CHECK_CLOSE(loss(tape).value[0], expected, 1e-6);  // sevenths in float
}

TEST(sac_gradient_of_the_temperature_loss_equals_central_differences) {
    Tape<double> tape(one_thread());
    const Tensor<double> log_prob = tape.make(5, 1);
    for (ptrdiff_t i = 0; i < 5; ++i) log_prob.value[i] = static_cast<double>(i) - 1.25;  // mean 0.75
    Parameter<double> log_alpha{"log_alpha", {1}, {0.4}, {0.0}};
    CHECK_CLOSE(sac::temperature_loss(log_alpha, log_prob, -3.0), -0.4 * (0.75 - 3), 1e-12);
    const double gradient = log_alpha.gradient[0];
    const auto at = [&](double x) {
        log_alpha.value[0] = x;
        return sac::temperature_loss(log_alpha, log_prob, -3.0);
    };
    CHECK_CLOSE(gradient, (at(0.41) - at(0.39)) / 0.02, 1e-10);
    CHECK(gradient > 0);  // the entropy, -0.75, is above its target, -3: alpha must fall
}

TEST(sac_target_is_that_of_plain_loops_and_only_termination_ends_it) {
    Tiny tiny;
    sac::Settings settings;
    settings.discount = 0.9;
    settings.reward_scale = 2;
    Tape<double> tape(one_thread());
    const auto batch = tiny.batch(tape);
    const auto target = sac::q_target(tape, tiny.policy, tiny.targets, batch, tiny.next_noise.data(), 0.3, settings);
    CHECK(tape.recording);
    for (size_t i = 0; i < Tiny::rows; ++i) {
        std::vector<double> x(tiny.replay.next_state(i), tiny.replay.next_state(i) + 3);
        const std::vector<double> output = plain_forward(tiny.policy, x);
        double log_prob = 0;
        for (size_t j = 0; j < 2; ++j) {
            const double z = static_cast<double>(tiny.next_noise[2 * i + j]),
                         u = output[j] + std::exp(output[2 + j]) * z;
            x.push_back(std::tanh(u));
            log_prob += -z * z / 2 - output[2 + j] - half_log_2_pi - std::log(1 - std::tanh(u) * std::tanh(u));
        }
        const double next = std::min(plain_forward(tiny.targets[0], x)[0], plain_forward(tiny.targets[1], x)[0]);
        const double follows =
            i == 2 ? 0 : 0.9 * (next - 0.3 * log_prob);  // row 4 was cut by the time limit: it counts
        CHECK_CLOSE(target[i], 2 * static_cast<double>(tiny.replay.reward(i)) + follows, 2e-6);
    }
}

TEST(sac_targets_after_n_soft_updates_have_their_closed_form) {
    std::vector<float> value = {1, -2, 0.5f}, target = {0, 3, 0.5f};
    const std::vector<float> start = target;
    const int n = 400;
    for (int i = 0; i < n; ++i) sac::soft_update(target, value, 5e-3f);
    for (size_t i = 0; i < target.size(); ++i)
        CHECK_CLOSE(target[i], value[i] + (start[i] - value[i]) * std::pow(1 - 5e-3, n), n * 3e-7);
}

// ---------------------------------------------------------------------------------------------------------------------
// Learning

namespace {

// A point on a line: x' = x + a / 2 costs x'^2; from |x| <= 1/2 the goal, 0, is one step away, from elsewhere two.
// Optionally the engine fails at a step, or the task ends when the point has left [-3, 3].
struct Rail : Environment {
    int limit;
    int fails_at = 0;  // step of each odd episode
    const char* fails_with = "environment.unstable";
    bool bounded = false;
    double x = 0;
    int steps = 0;
    bool odd = false;

    explicit Rail(int time_limit = 5) : limit(time_limit) {}
    EnvironmentSpec spec() const override { return {1, 1, 0, limit}; }
    void reset(const Random& random, uint64_t episode, float* state) override {
        x = 2 * random.uniform(episode, 0) - 1;
        steps = 0;
        odd = episode % 2 == 1;
        *state = static_cast<float>(x);
    }
    Step step(const float* action, float* state) override {
        if (++steps == fails_at && odd) fail(fails_with, "the engine fails");
        x += static_cast<double>(*action) / 2;
        *state = static_cast<float>(x);
        return {-x * x, bounded && std::fabs(x) > 3};
    }
    std::unique_ptr<Environment> clone() const override { return std::make_unique<Rail>(*this); }
};

// One action and the end: pays 1 - (a - 0.6)^2.
struct Bandit : Environment {
    EnvironmentSpec spec() const override { return {1, 1, 0, 10}; }
    void reset(const Random&, uint64_t, float* state) override { *state = 1; }
    Step step(const float* action, float* state) override {
        *state = 1;
        const double miss = static_cast<double>(*action) - 0.6;
        return {1 - miss * miss, true};
    }
    std::unique_ptr<Environment> clone() const override { return std::make_unique<Bandit>(*this); }
};

// An episode with the policy's mean actions.
Episode play_mean(sac::Learner& learner, Environment& environment, uint64_t number) {
    return play(environment, {test_seed(), Stream::environment}, number, [&](const Episode& episode) {
        const std::vector<float> no_noise(learner.spec.action_dim);
        return sac::act(learner.acting, learner.policy, episode.state.data(), no_noise).first;
    });
}

// Mean return of `count` episodes of the learner's policy, numbered from first_episode, leaving out those in which the
// simulation broke down.
double evaluate(sac::Learner& learner, Environment& environment, uint64_t first_episode, uint64_t count, bool sampled) {
    double total = 0, sound = 0;
    for (uint64_t i = 0; i < count; ++i) {
        const Episode episode =
            sampled ? sac::play_sampled(learner.acting, learner.policy, environment, test_seed(), first_episode + i)
                    : play_mean(learner, environment, first_episode + i);
        if (!episode.error.empty()) continue;
        total += episode.total_reward;
        sound += 1;
    }
    return total / sound;
}

sac::Settings small_settings() {
    sac::Settings settings;
    settings.seed = test_seed();
    settings.hidden = 32;
    settings.batch = 64;
    settings.capacity = 3000;
    settings.random_steps = 300;
    settings.learning_rate = 3e-3;
    settings.target_rate = 2e-2;
    return settings;
}

}  // namespace

TEST(sac_learns_a_task_whose_best_return_is_known) {
    Rail environment, evaluation;
    sac::Settings settings = small_settings();
    settings.discount = 0.9;
    sac::Learner learner(settings, environment.spec(), one_thread());
    for (int i = 0; i < 4000; ++i) learner.step(environment);
    double best = 0;
    constexpr int episodes = 50;
    for (uint64_t i = 0; i < episodes; ++i) {
        float x;
        evaluation.reset(Random{test_seed(), Stream::environment}, 1000000 + i, &x);
        const double left = std::max(std::fabs(static_cast<double>(x)) - 0.5, 0.0);
        best -= left * left / episodes;
    }
    const double found = evaluate(learner, evaluation, 1000000, episodes, false);
    CHECK(found <= best + 1e-9);
    CHECK_CLOSE(found, best, 0.02);  // without learning: about -2
    const double sampled = evaluate(learner, evaluation, 1000000, episodes, true);
    CHECK(sampled < found && sampled > -0.4);
    std::vector<float> log_probs;
    for (uint64_t i = 0; i < episodes; ++i)
        sac::play_sampled(learner.acting, learner.policy, evaluation, test_seed(), 1000000 + i, &log_probs);
    const double entropy = -std::accumulate(log_probs.begin(), log_probs.end(), 0.0) / (5 * episodes);
    CHECK_CLOSE(entropy, -1, 0.5);  // the temperature holds it at -dim A
}

TEST(sac_values_of_a_bandit_are_its_rewards_and_its_best_action_is_found) {
    Bandit environment;
    sac::Learner learner(small_settings(), environment.spec(), one_thread());
    for (int i = 0; i < 2000; ++i) learner.step(environment);
    CHECK_EQUAL(learner.progress.episodes, uint64_t{2000});
    const float state = 1;
    CHECK_CLOSE(sac::act(learner.acting, learner.policy, &state, {0}).first[0], 0.6, 0.1);
    for (const double a : {0.2, 0.6, 0.9})
        for (const sac::Network<float>& critic : learner.critics)
            CHECK_CLOSE(plain_forward(critic, {1, a})[0], 1 - (a - 0.6) * (a - 0.6), 0.05);
}

// Adam's first step is lr sign(gradient); policy, temperature and each critic have moments of their own.
TEST(sac_first_update_moves_the_temperature_by_its_learning_rate) {
    Rail environment;
    sac::Settings settings = small_settings();
    settings.random_steps = 20;
    sac::Learner learner(settings, environment.spec(), one_thread());
    for (int i = 0; i < 20; ++i) learner.step(environment);
    CHECK_EQUAL(learner.progress.updates, uint64_t{0});
    const std::vector<float> before = learner.critics[0].parameters[0].value;
    learner.step(environment);
    CHECK_EQUAL(learner.progress.updates, uint64_t{1});
    CHECK_CLOSE(learner.log_alpha[0].value[0], -3e-3, 1e-6);  // an untrained policy's entropy is above -1
    for (const Optimizer* optimizer : {&learner.policy_optimizer, &learner.alpha_optimizer,
                                       &learner.critic_optimizers[0], &learner.critic_optimizers[1]})
        CHECK_EQUAL(optimizer->updates, uint64_t{1});
    const std::vector<float>&after = learner.critics[0].parameters[0].value,
          &target = learner.targets[0].parameters[0].value;
    CHECK(before != after);
    for (size_t i = 0; i < before.size(); ++i) CHECK_CLOSE(target[i], before[i] + 0.02f * (after[i] - before[i]), 1e-6);
}

// Both losses of the first update in plain loops, from the numbers that the streams' table promises.
TEST(sac_update_draws_what_is_documented) {
    Rail environment;
    sac::Settings settings = small_settings();
    settings.random_steps = 20;
    settings.batch = 16;
    sac::Learner learner(settings, environment.spec(), one_thread());
    for (int i = 0; i < 20; ++i) learner.step(environment);
    const Random first_action{settings.seed, Stream::exploration};
    CHECK_EQUAL(learner.replay.action(7)[0],
                static_cast<float>(2 * first_action.uniform(1, 2, 0) - 1));  // episodes of 5
    const sac::Network<float> policy = learner.policy;
    const sac::Pair<float> critics = learner.critics;
    const auto [critic_loss, policy_loss] = learner.update();
    const double alpha = std::exp(static_cast<double>(learner.log_alpha[0].value[0]));

    const auto least = [&](double state, double action) {
        return std::min(plain_forward(critics[0], {state, action})[0], plain_forward(critics[1], {state, action})[0]);
    };
    const auto draw = [&](double state, uint32_t row, uint32_t site) {  // action, log-probability
        const double z = static_cast<double>(Random{settings.seed, Stream::entropy_noise}.normal(0, row, site));
        const std::vector<double> output = plain_forward(policy, {state});
        const double a = std::tanh(output[0] + std::exp(output[1]) * z);
        return std::pair(a, -z * z / 2 - output[1] - half_log_2_pi - std::log(1 - a * a));
    };
    double critic = 0, actor = 0;
    for (uint32_t i = 0; i < 16; ++i) {
        const size_t row = Random{settings.seed, Stream::batch}.below(20, 0, i);
        const sac::Replay& replay = learner.replay;
        const double state = static_cast<double>(replay.row(row)[0]),
                     next = static_cast<double>(replay.next_state(row)[0]),
                     taken = static_cast<double>(replay.action(row)[0]);
        const auto [a, log_prob] = draw(state, i, 0);
        const auto [next_a, next_log_prob] = draw(next, i, 1);
        actor += (alpha * log_prob - least(state, a)) / 16;
        const double y = static_cast<double>(replay.reward(row)) + 0.99 * (least(next, next_a) - alpha * next_log_prob);
        for (const sac::Network<float>& q : critics)
            critic += (plain_forward(q, {state, taken})[0] - y) * (plain_forward(q, {state, taken})[0] - y) / 16;
    }
    CHECK_CLOSE(critic_loss, critic, 1e-5);
    CHECK_CLOSE(policy_loss, actor, 1e-5);
}

namespace {
// Two actions, whose product is paid, and five steps.
struct Plane : Environment {
    EnvironmentSpec spec() const override { return {1, 2, 0, 5}; }
    void reset(const Random&, uint64_t, float* state) override { *state = 0; }
    Step step(const float* action, float* state) override { return {*state = action[0] * action[1], false}; }
    std::unique_ptr<Environment> clone() const override { return std::make_unique<Plane>(*this); }
};
}  // namespace

// Of action j: site j of its step or its row, in the loss of the first update as well.
TEST(sac_numbers_of_two_actions_are_those_of_the_table) {
    Plane environment;
    sac::Settings settings = small_settings();
    settings.random_steps = 20;
    settings.batch = 16;
    sac::Learner learner(settings, environment.spec(), one_thread());
    for (int i = 0; i < 20; ++i) learner.step(environment);
    for (uint32_t j = 0; j < 2; ++j)
        CHECK_EQUAL(learner.replay.action(7)[j],
                    static_cast<float>(2 * Random{settings.seed, Stream::exploration}.uniform(1, 2, j) - 1));
    const sac::Network<float> policy = learner.policy;
    const sac::Pair<float> critics = learner.critics;
    const float policy_loss = learner.update().second;
    const double alpha = std::exp(static_cast<double>(learner.log_alpha[0].value[0]));
    double expected = 0;
    for (uint32_t i = 0; i < 16; ++i) {
        const float* row = learner.replay.row(Random{settings.seed, Stream::batch}.below(20, 0, i));
        const std::vector<double> output = plain_forward(policy, {*row});
        std::vector<double> pair = {*row};
        for (uint32_t j = 0; j < 2; ++j) {
            const double z = static_cast<double>(Random{settings.seed, Stream::entropy_noise}.normal(0, i, j));
            const double a = pair.emplace_back(std::tanh(output[j] + std::exp(output[2 + j]) * z));
            expected += alpha * (-z * z / 2 - output[2 + j] - half_log_2_pi - std::log(1 - a * a)) / 16;
        }
        expected -= std::min(plain_forward(critics[0], pair)[0], plain_forward(critics[1], pair)[0]) / 16;
    }
    CHECK_CLOSE(policy_loss, expected, 1e-5);
}

// Six tensors each: the policy's are numbered from 0, the critics' from 6 and 12.
TEST(sac_critics_begin_with_numbers_of_their_own) {
    const sac::Settings settings = small_settings();
    const sac::Learner learner(settings, Plane{}.spec(), one_thread());
    const Random random{settings.seed, Stream::initialisation};
    for (uint32_t k = 0; k < 2; ++k)
        for (uint32_t i = 0; i < 9; ++i)
            CHECK_CLOSE(learner.critics[k].parameters[0].value[i],
                        (2 * random.uniform(6 * (k + 1), i) - 1) / std::sqrt(32.0), 1e-7);
}

TEST(sac_episodes_end_by_the_task_the_time_limit_or_the_engine) {
    Rail environment;
    environment.bounded = true;
    environment.limit = 30;
    environment.fails_at = 4;
    sac::Settings settings = small_settings();
    settings.random_steps = 1000000;
    sac::Learner learner(settings, environment.spec(), one_thread());
    uint64_t ends[3] = {}, length = 0, failures = 0;
    for (uint64_t i = 0, rows = 0; i < 2000; ++i) {
        learner.step(environment);
        if (learner.replay.size() == rows) {
            ++failures;
            CHECK(learner.replay.end(learner.replay.recent(1)) == sac::End::cut);
            CHECK_EQUAL(length, uint64_t{3});
        } else {
            const sac::End end = learner.replay.end(learner.replay.recent(1));
            ++ends[static_cast<size_t>(end)];
            const float x = learner.replay.next_state(learner.replay.recent(1))[0];
            CHECK_EQUAL(end == sac::End::terminated, std::fabs(x) > 3);
            CHECK_EQUAL(end == sac::End::cut, length + 1 == 30 && std::fabs(x) <= 3);
        }
        length = learner.progress.episode_steps;
        rows = learner.replay.size();
    }
    CHECK(ends[1] > 0 && ends[2] > 0 && failures > 10);
    CHECK_EQUAL(learner.progress.episodes, ends[1] + ends[2] + failures);
    environment.fails_with = "some.other";
    CHECK_FAILS("some.other", while (true) learner.step(environment));
}

TEST(sac_refuses_discrete_actions_and_a_replay_below_an_episode) {
    sac::Settings settings = small_settings();
    CHECK_FAILS("sac.settings", sac::Learner(settings, {1, 1, 8, 5}, one_thread()));
    settings.capacity = 4;
    CHECK_FAILS("sac.settings", sac::Learner(settings, {1, 1, 0, 5}, one_thread()));
    settings = small_settings();
    settings.steps_per_update = 0;
    CHECK_FAILS("sac.settings", sac::Learner(settings, {1, 1, 0, 5}, one_thread()));
}

TEST(sac_updates_at_every_nth_step_once_acting_at_random_is_over) {
    sac::Settings settings = small_settings();
    settings.random_steps = 10;
    settings.steps_per_update = 3;
    Rail environment;
    sac::Learner learner(settings, environment.spec(), one_thread());
    std::vector<uint64_t> at;  // the steps of the updates
    while (learner.progress.steps < 20) {
        const uint64_t before = learner.progress.updates;
        learner.step(environment);
        if (learner.progress.updates == before + 1) at.push_back(learner.progress.steps);
    }
    CHECK(at == (std::vector<uint64_t>{12, 15, 18}));
    const std::vector<float> policy = learner.policy.parameters[0].value;
    for (int i = 0; i < 10; ++i) learner.interact(environment);  // acts, and learns nothing
    CHECK(learner.progress.updates == 3 && learner.progress.steps == 30 && learner.replay.size() == 30);
    CHECK(learner.policy.parameters[0].value == policy);
}

// ---------------------------------------------------------------------------------------------------------------------
// Stopping and resuming

namespace {

// `steps` steps, stopped and resumed after the first `stop` where that is not 0: the bytes of the checkpoint.
std::string run_bytes(const sac::Settings& settings, const Environment& fresh, int steps, int stop, Compute& compute) {
    TemporaryFile file("run");
    auto learner = std::make_unique<sac::Learner>(settings, fresh.spec(), compute);
    auto environment = fresh.clone();
    for (int i = 0; i < steps; ++i) {
        if (i == stop && stop > 0) {
            sac::save_checkpoint(file.path, *learner, "task=line");
            learner = std::make_unique<sac::Learner>(settings, fresh.spec(), compute);
            environment = fresh.clone();
            sac::load_checkpoint(file.path, *learner, "task=line");
            learner->resume(*environment);
        }
        learner->step(*environment);
    }
    sac::save_checkpoint(file.path, *learner, "task=line");
    return read_file(file.path);
}

}  // namespace

TEST(sac_resumed_run_has_the_same_bytes_for_any_number_of_threads) {
    sac::Settings settings = small_settings();
    settings.random_steps = 40;
    settings.capacity = 90;  // the ring wraps
    settings.hidden = 48;
    const std::string whole = run_bytes(settings, Rail{}, 120, 0, one_thread());
    for (const int stop : {13, 60, 103})  // during an episode while acting at random; between two; with a full ring
        CHECK(run_bytes(settings, Rail{}, 120, stop, one_thread()) == whole);
    Compute two_threads(best_kernel(), 2);
    CHECK(run_bytes(settings, Rail{}, 120, 61, two_threads) == whole);
    settings.seed += 1;
    CHECK(run_bytes(settings, Rail{}, 120, 0, one_thread()) != whole);
}

#ifdef WODTEM_MUJOCO
TEST(sac_resumed_run_of_hopper_has_the_same_bytes) {
    sac::Settings settings = small_settings();
    settings.random_steps = 50;
    settings.capacity = 2000;
    const MujocoEnvironment hopper(*find_mujoco_task("hopper"), Physics::d4rl);
    const std::string whole = run_bytes(settings, hopper, 120, 0, one_thread());
    for (const int stop : {31, 88}) CHECK(run_bytes(settings, hopper, 120, stop, one_thread()) == whole);
}
#endif

TEST(sac_checkpoint_of_another_run_is_refused) {
    TemporaryFile file("checkpoint");
    const sac::Settings settings = small_settings();
    Rail environment;
    sac::Learner learner(settings, environment.spec(), one_thread());
    for (int i = 0; i < 7; ++i) learner.step(environment);
    sac::save_checkpoint(file.path, learner, "task=line");
    CHECK_FAILS("sac.checkpoint", sac::load_checkpoint(file.path, learner, "task=other"));
    using Change = void (*)(sac::Settings&);
    for (const Change change :
         {Change([](auto& s) { s.discount = 0.5; }), Change([](auto& s) { s.reward_scale = 2; }),
          Change([](auto& s) { s.steps_per_update = 2; }), Change([](auto& s) { s.target_rate = 0.5; })}) {
        sac::Settings other = settings;
        change(other);
        sac::Learner changed(other, environment.spec(), one_thread());
        CHECK_FAILS("sac.checkpoint", sac::load_checkpoint(file.path, changed, "task=line"));
    }
    sac::Learner same(settings, environment.spec(), one_thread());
    sac::load_checkpoint(file.path, same, "task=line");
    Rail elsewhere;
    elsewhere.limit = 5;
    same.state[0] += 1;  // as if the environment went another way
    CHECK_FAILS("sac.resume", same.resume(elsewhere));
    sac::save_policy(file.path, learner.policy);
    CHECK_FAILS("safetensors.missing", sac::load_checkpoint(file.path, same, "task=line"));
}

// ---------------------------------------------------------------------------------------------------------------------
// Policies

TEST(sac_policy_file_keeps_every_bit_and_has_the_names_and_shapes_of_d4rl) {
    TemporaryFile file("policy");
    const sac::Network<float> network(11, 256, 6, 0.05, test_seed(), 0);
    sac::save_policy(file.path, network,
                     {{"task", "hopper"}, {"physics", "d4rl"}, {"return", "1422.1"}, {"steps", "7"}});
    const TensorFile raw = read_safetensors(file.path);
    CHECK_EQUAL(raw.tensors.size(), size_t{8});
    const std::vector<float> fc0 = raw.get<float>("fc0.weight", {256, 11}), fc1 = raw.get<float>("fc1.bias", {256});
    const auto mean = raw.get<float>("last_fc.weight", {3, 256}),
               log_std = raw.get<float>("last_fc_log_std.weight", {3, 256}),
               mean_bias = raw.get<float>("last_fc.bias", {3}),
               log_std_bias = raw.get<float>("last_fc_log_std.bias", {3});
    CHECK(fc0 == network.parameters[0].value && fc1 == network.parameters[3].value);
    CHECK_EQUAL(raw.text("return"), "1422.1");
    CHECK_EQUAL(raw.text("output_distribution"), "tanh_gaussian");

    CHECK_EQUAL(raw.text("task"), "hopper");
    sac::Network<float> loaded = sac::policy_of(raw);
    for (size_t i = 0; i < 6; ++i) {
        CHECK(loaded.parameters[i].value == network.parameters[i].value);
        CHECK(loaded.parameters[i].shape == network.parameters[i].shape);
    }

    // Mean and log standard deviation as a reader of the file would compute them.
    Draws draws{3};
    const auto state = draws.normals(11), noise = draws.normals(3);
    const std::vector<double> output = plain_forward(network, {state.begin(), state.end()});
    Tape<float> tape(one_thread());
    const auto [action, log_prob] = sac::act(tape, loaded, state.data(), noise);
    double expected = 0;
    for (size_t j = 0; j < 3; ++j) {
        const double z = static_cast<double>(noise[j]), a = std::tanh(output[j] + std::exp(output[3 + j]) * z);
        CHECK_CLOSE(action[j], a, 1e-5);
        expected += -z * z / 2 - output[3 + j] - half_log_2_pi - std::log(1 - a * a);
        CHECK_EQUAL(mean[j * 256 + 5], network.parameters[4].value[j * 256 + 5]);
        CHECK_EQUAL(log_std[j * 256 + 5], network.parameters[4].value[(3 + j) * 256 + 5]);
        CHECK_EQUAL(mean_bias[j], network.parameters[5].value[j]);
        CHECK_EQUAL(log_std_bias[j], network.parameters[5].value[3 + j]);
    }
    CHECK_CLOSE(log_prob, expected, 1e-4);
}

TEST(sac_policy_file_that_is_none_is_refused) {
    TemporaryFile file("policy");
    TensorFile other;
    other.add("fc0.weight", {2}, std::vector<float>{1, 2});
    other.add("last_fc.weight", {1, 2}, std::vector<float>{1, 2});
    write_safetensors(file.path, other);
    CHECK_FAILS("sac.policy", sac::policy_of(read_safetensors(file.path)));
    write_safetensors(file.path, TensorFile{});
    CHECK_FAILS("safetensors.missing", sac::policy_of(read_safetensors(file.path)));
    sac::save_policy(file.path, sac::Network<float>(2, 8, 4, 1, 0, 0));
    std::string bytes = read_file(file.path);
    bytes[bytes.size() - 3] = static_cast<char>(bytes[bytes.size() - 3] ^ 1);
    write_file_atomic(file.path, bytes);
    CHECK_FAILS("safetensors.checksum", sac::policy_of(read_safetensors(file.path)));
}

TEST(sac_played_episode_is_a_function_of_seed_and_number) {
    Rail environment;
    environment.fails_at = 3;
    sac::Learner learner(small_settings(), environment.spec(), one_thread());
    std::vector<float> log_probs, log_probs_again;
    const auto sampled = [&](uint64_t number, std::vector<float>* written = nullptr) {
        return sac::play_sampled(learner.acting, learner.policy, environment, test_seed(), number, written);
    };
    const Episode a = sampled(4, &log_probs), again = sampled(4, &log_probs_again);
    CHECK_EQUAL(a.trajectory.rewards.size(), size_t{5});
    CHECK(a.trajectory.actions == again.trajectory.actions && a.trajectory.states == again.trajectory.states);
    CHECK(log_probs.size() == 5 && log_probs_again == log_probs);
    const Episode failed = sampled(5);
    CHECK(!a.trajectory.terminated && a.error.empty() && !failed.error.empty());
    CHECK_EQUAL(failed.trajectory.length(), 3);
    const Episode mean = play_mean(learner, environment, 4);
    CHECK(a.trajectory.actions != mean.trajectory.actions && a.trajectory.states[0] == mean.trajectory.states[0]);
    double total = 0;
    for (const float reward : a.trajectory.rewards) total += static_cast<double>(reward);
    CHECK_CLOSE(total, a.total_reward, 1e-5);
    CHECK(std::isnan(evaluate(learner, environment, 5, 1, true)));
    CHECK_EQUAL(evaluate(learner, environment, 4, 2, true), a.total_reward);
}
