// test_wodtem.cpp: the method and the command line: the objective against its equations written out, the phases against
// the paper's sentences, runs against themselves (threads, kills, alpha = 1), bad input against its sentence.
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/wait.h>

#include <ctime>
#include <fstream>

#define WODTEM_NO_MAIN
#include "../wodtem.cpp"
#include "fuzz.cpp"
#include "hdf5_files.hpp"
#include "test.hpp"

namespace {

namespace fs = std::filesystem;

// A fresh folder that goes away with the test.
struct Scratch {
    std::string path;
    Scratch() {
        char name[] = "/tmp/wodtem-test-XXXXXX";
        path = mkdtemp(name);
    }
    ~Scratch() { fs::remove_all(path); }
    std::string operator/(const std::string& name) const { return path + "/" + name; }
};

// A run that takes a fraction of a second.
Settings tiny_settings(const std::string& method, const std::string& alpha = "0.75") {
    Settings settings = default_settings("gridworld", method, "small");
    for (auto [name, value] : std::initializer_list<std::pair<const char*, const char*>>{{"width", "8"},
                                                                                         {"batch_size", "32"},
                                                                                         {"offline_updates", "40"},
                                                                                         {"updates_per_iteration", "5"},
                                                                                         {"eval_every", "3"},
                                                                                         {"learning_rate", "0.01"},
                                                                                         {"warmup_updates", "10"},
                                                                                         {"data_trajectories", "60"},
                                                                                         {"buffer_size", "20"}})
        set_setting(settings, name, value);
    if (method != "dt") set_setting(settings, "online_steps", "400");
    set_setting(settings, "alpha", alpha);
    settings.arithmetic = best_kernel().arithmetic();
    return settings;
}

// Calls f() with nothing printed.
void quietly(const std::function<void()>& f) { printed(f); }

void quiet_train(
    const Settings& settings, const std::string& folder, int threads = 1, double checkpoint_every = 1e9,
    const std::function<bool()>& asked_to_stop = [] { return stop_requested != 0; }, bool keep_state = false) {
    quietly([&] {
        train(settings, folder,
              {.kernel = kernel_for(settings.arithmetic),
               .threads = threads,
               .checkpoint_every = checkpoint_every,
               .keep_state = keep_state,
               .asked_to_stop = asked_to_stop});
    });
}

// Trains until the run asks for the `last`-th time whether to stop: it is told yes, and must say that it stopped. A run
// asks once before it draws its network, and from then on several times in each update and each step of an episode.
void train_until(const Settings& settings, const std::string& folder, uint64_t last, int threads = 1) {
    uint64_t asked = 0;
    CHECK_FAILS("run.stopped", quiet_train(settings, folder, threads, 1e9, [&] { return ++asked >= last; }));
}

const char* const result_files[] = {"progress.csv", "episodes.csv", "model.safetensors", "policy.csv",
                                    "start_actions.csv"};

void check_same_results(const std::string& a, const std::string& b) {
    for (const char* name : result_files) {
        if (read_file(a + "/" + name) != read_file(b + "/" + name))
            report_failure(__FILE__, __LINE__, a + " and " + b + " differ in " + name);
    }
}

// A run ready for its first update, and what it stands on.
struct Fixture {
    Compute compute;
    Run run;
    explicit Fixture(const Settings& settings)
        : compute(best_kernel(), 1),
          run(compute, settings, make_grid_world(settings)) {
        begin_run(run, make_data_set(settings));
    }
    void save(const std::string& path) { save_model(contents_of(run.agent), path); }
    void save_checkpoint(const std::string& path) {
        RunFolder folder{path};
        folder.begin_logs(run.agent.settings);
        ::save_checkpoint(folder, run.agent.settings, [&](auto& archive) { visit_state(archive, run); });
    }
    void load(const std::string& path) {
        ModelContents contents = contents_of(run.agent);
        load_model(contents, open_model(path));
    }
};

// The episodes of `count` copies of an environment, as rollout() plays them.
std::vector<Episode> roll_out(Run& run, const Environment& environment, Act act, double target, uint64_t first,
                              size_t count) {
    std::vector<std::unique_ptr<Environment>> copies;
    std::vector<Environment*> environments;
    for (size_t i = 0; i < count; ++i) {
        copies.push_back(environment.clone());
        environments.push_back(copies.back().get());
    }
    return rollout(run.agent, run.acting, environments, act, target, first);
}

// A batch for the Gaussian and the categorical head alike: two windows of 1 and 3 steps.
Batch painted_batch(int state_dim, int action_dim, int moves) {
    Batch batch;
    batch.sequences.lengths = {1, 3};
    const auto paint = [](int i) { return static_cast<float>((i * 37) % 251 - 125) / 128.0f; };
    for (int i = 0; i < 4; ++i) {
        batch.sequences.returns_to_go.push_back(paint(i + 11));
        batch.sequences.timesteps.push_back(i);
        batch.coefficients.push_back(i == 0 ? 0.5f : 0.5f / 3);
        batch.weights.push_back(i % 2 == 0 ? 1.0f : 0.75f);
    }
    for (int i = 0; i < 4 * state_dim; ++i) batch.sequences.states.push_back(paint(i));
    for (int i = 0; i < 4 * (moves > 0 ? moves : action_dim); ++i) batch.sequences.actions.push_back(paint(i + 50));
    for (int i = 0; i < 4 * action_dim; ++i) {
        batch.actions.push_back(moves > 0 ? static_cast<float>(i % moves) : paint(i + 90));
        batch.advised_actions.push_back(moves > 0 ? static_cast<float>((3 * i + 1) % moves) : paint(i + 130));
    }
    return batch;
}

TransformerConfig tiny_config(Head head, int state_dim, int action_dim) {
    return {state_dim, action_dim, 2, 2, 8, 6, 0.1f, head};
}

}  // namespace

// The program itself.
namespace {
struct Outcome {
    int status;
    std::string text;
};
Outcome shell(const std::string& command) {
    FILE* pipe = popen((command + " 2>&1").c_str(), "r");
    Outcome outcome = {0, ""};
    for (int c; (c = std::fgetc(pipe)) != EOF;) outcome.text += static_cast<char>(c);
    outcome.status = WEXITSTATUS(pclose(pipe));
    return outcome;
}
void check_shell(const std::string& command, int status, const std::string& part) {
    const Outcome outcome = shell(command);
    if (outcome.status != status || outcome.text.find(part) == std::string::npos)
        report_failure(__FILE__, __LINE__,
                       command + ": status " + std::to_string(outcome.status) + ", said: " + outcome.text);
}
}  // namespace

// ---------------------------------------------------------------------------------------------------------------------
// Settings

// WODTEM Table I test
TEST(the_paper_preset_is_table_one) {
    const Settings s = default_settings("gridworld", "wodtem", "paper");
    const std::map<std::string, std::string> table = {{"layers", "1"},
                                                      {"heads", "1"},
                                                      {"width", "512"},
                                                      {"context_length", "1"},
                                                      {"weight_decay", "0"},
                                                      {"learning_rate", "0.001"},
                                                      {"offline_updates", "1000"},
                                                      {"updates_per_iteration", "50"},
                                                      {"buffer_size", "500"},
                                                      {"position", "no"},
                                                      {"g_online", "2"},
                                                      {"g_eval", "1"},
                                                      // sec. V-D
                                                      {"projected_dim", "0"},
                                                      {"table_size", "36"},
                                                      {"gamma", "0.99"},
                                                      {"K", "1"},
                                                      {"epsilon", "0.1"},
                                                      {"alpha", "0.75"},
                                                      {"online_steps", "20000"},
                                                      // ODT's code
                                                      {"batch_size", "256"},
                                                      {"dropout", "0.1"},
                                                      {"warmup_updates", "10000"},
                                                      {"clip_norm", "0.25"},
                                                      {"initial_lambda", "0.1"},
                                                      {"lambda_learning_rate", "1e-04"},
                                                      {"optimizer", "lamb"},
                                                      {"eval_every", "10"}};
    for (const auto& [name, value] : table)
        CHECK_EQUAL(name + " = " + setting_text(s, setting_row(name)), name + " = " + value);
}

// WODTEM Table II test, and sec. V-C
TEST(the_other_tasks_have_table_two_and_the_per_dataset_values) {
    const auto check = [](const char* task, const std::map<std::string, std::string>& table) {
        const Settings s = default_settings(task, "wodtem", "paper");
        for (const auto& [name, value] : table)
            CHECK_EQUAL(task + (" " + name) + " = " + setting_text(s, setting_row(name)),
                        task + (" " + name) + " = " + value);
    };
    for (const char* task : {"maze2d-umaze-v1", "maze2d-medium-v1", "maze2d-large-v1"})
        check(task, {{"layers", "4"},
                     {"heads", "4"},
                     {"width", "512"},
                     {"context_length", "20"},
                     {"weight_decay", "0"},
                     {"learning_rate", "0.001"},
                     {"offline_updates", "20000"},
                     {"updates_per_iteration", "300"},
                     {"buffer_size", "1500"},
                     {"position", "yes"},
                     {"epsilon", "0.1"},
                     {"projected_dim", "4"},
                     {"alpha", "0.9"},
                     {"K", "2"},
                     {"online_steps", "200000"}});
    check("maze2d-umaze", {{"g_online", "340"}, {"g_eval", "170"}, {"table_size", "2000000"}, {"eta", "-2"}});
    check("maze2d-medium", {{"g_online", "560"}, {"g_eval", "280"}, {"table_size", "2000000"}});
    check("maze2d-large", {{"g_online", "560"}, {"g_eval", "280"}, {"table_size", "4000000"}});
    check("hopper-medium", {{"learning_rate", "1e-04"},
                            {"weight_decay", "5e-04"},
                            {"g_eval", "3600"},
                            {"g_online", "7200"},
                            {"epsilon", "0.1"},
                            {"eta", "-3"}});
    check("hopper-medium-replay", {{"learning_rate", "0.002"}, {"weight_decay", "1e-04"}, {"offline_updates", "5000"}});
    check("walker2d-medium", {{"learning_rate", "0.001"},
                              {"offline_updates", "10000"},
                              {"epsilon", "0.2"},
                              {"g_eval", "5000"},
                              {"eta", "-6"}});
    check("halfcheetah-medium-replay", {{"epsilon", "0.6"}, {"g_eval", "6000"}, {"g_online", "12000"}});
    check("ant-medium", {{"epsilon", "0.3"}, {"eta", "-8"}, {"reward_scale", "0.001"}});
    check("antmaze-umaze-diverse", {{"epsilon", "0.3"},
                                    {"width", "1024"},
                                    {"position", "yes"},
                                    {"reward_scale", "1"},
                                    {"g_online", "2"},
                                    {"eta", "-8"}});
    const Settings dt = default_settings("hopper-medium-v2", "dt", "paper");
    CHECK(dt.width == 128 && dt.layers == 3 && dt.heads == 1 && dt.batch_size == 64 && dt.optimizer == "adamw" &&
          dt.eval_context == 20);
    for (const char* method : {"dt", "odt", "wodtem"})  // no value is credited to the grid world's table
        CHECK(settings_text(default_settings("hopper-medium-v2", method, "paper")).find("Table I:") ==
              std::string::npos);
}

TEST(the_small_preset_differs_in_width_alone) {
    const Settings paper = default_settings("gridworld", "odt", "paper"),
                   small = default_settings("gridworld", "odt", "small");
    for (const SettingRow& row : setting_rows) {
        const std::string name = row.name;
        if (name != "preset" && name != "width") CHECK_EQUAL(setting_text(small, row), setting_text(paper, row));
    }
    CHECK(small.width < paper.width);
}

TEST(the_small_preset_has_one_network_and_as_many_updates_for_all_methods) {
    for (const char* task : {"hopper-medium-v2", "walker2d-medium-replay-v2", "ant-medium-v2", "antmaze-umaze-v2",
                             "maze2d-umaze-v1", "maze2d-large-v1"}) {
        const Settings dt = default_settings(task, "dt", "small"), odt = default_settings(task, "odt", "small"),
                       wodtem = default_settings(task, "wodtem", "small");
        for (const char* name : {"layers", "heads", "width", "context_length", "position", "dropout", "batch_size",
                                 "learning_rate", "warmup_updates", "reward_scale", "g_eval"})
            CHECK_EQUAL(name + setting_text(dt, setting_row(name)), name + setting_text(odt, setting_row(name)));
        const int64_t episodes = (odt.online_steps + 299) / 300;  // of 300 steps, as maze2d-umaze's
        CHECK_EQUAL(dt.offline_updates, odt.offline_updates + episodes * odt.updates_per_iteration);
        for (const SettingRow& row : setting_rows)
            if (std::string(row.name) != "method") CHECK_EQUAL(setting_text(wodtem, row), setting_text(odt, row));
    }
}

// Preset reduced: Table II but for the network and what evaluation and the data's missing episodes call for.
TEST(the_reduced_preset_keeps_table_twos_schedule) {
    const std::set<std::string> reduced = {"preset",     "layers",         "heads",        "width",
                                           "dropout",    "context_length", "batch_size",   "position",
                                           "eval_every", "eval_episodes",  "reward_scale", "cut"};
    for (const char* task : {"maze2d-umaze-v1", "maze2d-large-v1", "walker2d-medium-v2"})
        for (const char* method : {"odt", "wodtem"}) {
            const Settings paper = default_settings(task, method, "paper"),
                           s = default_settings(task, method, "reduced");
            for (const SettingRow& row : setting_rows)
                if (!reduced.contains(row.name)) CHECK_EQUAL(setting_text(s, row), setting_text(paper, row));
            CHECK_EQUAL(s.cut, std::string(task).starts_with("maze2d") ? "episodes" : "flags");
            check_together(s);
        }
    CHECK_FAILS("usage.setting", default_settings("gridworld", "odt", "reduced"));
    Settings hopper = default_settings("hopper-medium-v2", "odt", "small");
    hopper.cut = "episodes";
    CHECK_FAILS("usage.setting", check_together(hopper));
}

TEST(settings_survive_being_written_and_read) {
    Settings s = tiny_settings("wodtem");
    set_setting(s, "epsilon", "0.30000000000000004");
    const std::string text = settings_text(s);
    CHECK_EQUAL(settings_text(settings_from_text(text, "memory")), text);
    for (const SettingRow& row : setting_rows) CHECK(std::string(row.source).size() > 3);
}

TEST(bad_settings_are_usage_errors_that_name_the_nearest) {
    Settings s;
    CHECK_FAILS("usage.setting", set_setting(s, "alhpa", "1"));
    CHECK_FAILS("usage.setting", set_setting(s, "alpha", "1.5"));
    CHECK_FAILS("usage.setting", set_setting(s, "alpha", "nan"));
    CHECK_FAILS("usage.setting", set_setting(s, "K", "1.5"));
    CHECK_FAILS("usage.setting", set_setting(s, "K", ""));
    CHECK_FAILS("usage.setting", set_setting(s, "eviction", "lfru"));
    CHECK_FAILS("usage.setting", set_setting(s, "position", "maybe"));
    try {
        set_setting(s, "epsilom", "1");
    } catch (const Error& error) {
        CHECK(std::string(error.what()).find("\"epsilon\"") != std::string::npos);
    }
    try {
        set_setting(s, "alpha", "1.5");
    } catch (const Error& error) {
        CHECK(std::string(error.what()).find("nearest is 1") != std::string::npos);
    }
    try {
        set_setting(s, "alpha", "x");
    } catch (const Error& error) {  // nothing is near what is no number
        CHECK_EQUAL(error.what(), std::string("alpha cannot be \"x\"; it is a number from 0 to 1"));
    }
}

// A megabyte of one word, and of lines with a name each: refused in a moment, in a sentence that can be read.
TEST(settings_of_a_megabyte_are_refused_at_once_and_in_few_words) {
    const std::string word(1 << 20, 'x');
    std::string lines;
    for (int i = 0; lines.size() < 1 << 20; ++i) lines += std::to_string(i) + " = 1 # s\n";
    const std::clock_t began = std::clock();
    for (const std::string& text : {word + " = 1 # s", "sampling = " + word + " # s", "position = " + word + " # s",
                                    "K = " + word + " # s", word, lines})
        try {
            settings_from_text(text, "file");
            report_failure(__FILE__, __LINE__, "not refused: " + text.substr(0, 20));
        } catch (const Error& error) {
            CHECK(std::string(error.what()).size() < 500);
        }
    CHECK(std::clock() - began < CLOCKS_PER_SEC);
}

// ---------------------------------------------------------------------------------------------------------------------
// Objective

// WODTEM eq. (1) test; WODTEM eq. (2) test; WODTEM eq. (3) test; WODTEM eq. (8) test; WODTEM eq. (9) test;
// WODTEM eq. (10) test: categorical policy, all sums written out in double.
TEST(objective_is_the_equations_written_out) {
    Compute compute(best_kernel(), 1);
    Tape<double> tape(compute);
    const Transformer<double> model(tiny_config(Head::categorical, 3, 5), test_seed());
    const Batch batch = painted_batch(3, 1, 5);
    tape.recording = true;
    tape.dropout_random.seed = test_seed();
    const Policy<double> policy = forward(tape, model, batch.sequences, Queries::every_state);
    const float lambda = 0.3f;
    const Objective<double> got = objective(tape, policy, batch, nullptr, lambda, true);

    double L = 0, J = 0, H = 0;
    const int first_step[] = {0, 1}, steps[] = {1, 3};
    for (int window = 0; window < 2; ++window) {
        double l = 0, j = 0, h = 0;
        for (int c = first_step[window]; c < first_step[window] + steps[window]; ++c) {
            const size_t at = static_cast<size_t>(c);
            const double* log_p = policy.output.value + c * 5;
            const double w = batch.weights[at], a = log_p[static_cast<int>(batch.actions[at])],
                         a_hat = log_p[static_cast<int>(batch.advised_actions[at])];
            l -= w * a + (1 - w) * a_hat;
            j -= a;
            for (int move = 0; move < 5; ++move) h -= std::exp(log_p[move]) * log_p[move];
        }
        L += l / steps[window] / 2, J += j / steps[window] / 2, H += h / steps[window] / 2;
    }
    CHECK_CLOSE(got.L.value[0], L, 1e-6);  // the coefficients 1 / (B |C^t|) are float32
    CHECK_CLOSE(got.H.value[0], H, 1e-6);
    CHECK_CLOSE(got.lagrangian.value[0], L - static_cast<double>(lambda) * H, 1e-6);
    CHECK(std::fabs(L - J) > 1e-3);  // the memory's part is there

    Batch plain = batch;
    plain.weights.assign(4, 1.0f);
    CHECK_CLOSE(objective(tape, policy, plain, nullptr, lambda, true).L.value[0], J, 1e-6);
}

// WODTEM eq. (8) test; WODTEM eq. (9) test; WODTEM eq. (10) test
// The whole objective, network included, against central differences, for every head and every parameter. Where a ReLU
// switches between the two points there is no derivative to compare with: the gradient jumps there, which its second
// difference shows, 1e-10 where it is smooth. Such parameters are few, and counted. The difference of two losses cannot
// be better than their rounding, and a Gaussian that is sure of itself makes the loss large.
TEST(objective_gradient_equals_central_differences) {
    Compute compute(best_kernel(), 1);
    for (const Head head : {Head::categorical, Head::squashed_gaussian, Head::deterministic}) {
        const int moves = head == Head::categorical ? 5 : 0, action_dim = moves > 0 ? 1 : 3;
        Transformer<double> model(tiny_config(head, 3, moves > 0 ? 5 : 3), test_seed());
        const Batch batch = painted_batch(3, action_dim, moves);
        const std::vector<float> noise = {0.3f, -1.2f, 0.7f, 0.1f, -0.4f, 2.0f, -0.9f, 0.5f, 1.1f, -0.2f, 0.6f, -1.5f};
        Tape<double> tape(compute);
        tape.dropout_random.seed = test_seed();
        const auto loss = [&] {  // and its gradient, in the parameters
            for (Parameter<double>& parameter : model.parameters) std::ranges::fill(parameter.gradient, 0.0);
            tape.reset();
            const Policy<double> policy = forward(tape, model, batch.sequences, Queries::every_state);
            const Tensor<double> lagrangian =
                objective(tape, policy, batch, noise.data(), 0.3f, head != Head::deterministic).lagrangian;
            tape.backward(lagrangian);
            return lagrangian.value[0];
        };
        double worst = 0, largest = 0;
        int compared = 0, kinks = 0;
        for (Parameter<double>& parameter : model.parameters) {
            loss();
            const std::vector<double> gradient = parameter.gradient;
            double scale = 1e-3;
            for (const double g : gradient) scale = std::max(scale, std::fabs(g));
            largest = std::max(largest, scale);
            for (size_t i = 0; i < parameter.value.size(); i += 1 + parameter.value.size() / 16) {
                const double kept = parameter.value[i], h = 1e-5;
                parameter.value[i] = kept + h;
                const double above = loss(), gradient_above = parameter.gradient[i],
                             rounding = std::fabs(above) * 0x1p-52;
                parameter.value[i] = kept - h;
                const double below = loss(), gradient_below = parameter.gradient[i];
                parameter.value[i] = kept;
                ++compared;
                if (std::fabs(gradient_above - 2 * gradient[i] + gradient_below) > 1e-7 * scale)
                    ++kinks;
                else
                    worst = std::max(worst,
                                     std::fabs((above - below) / (2 * h) - gradient[i]) / (scale + 4e6 * rounding / h));
            }
        }
        CHECK(largest > 1e-2);
        CHECK(50 * kinks < compared);
        CHECK_CLOSE(worst, 0, 1e-6);
    }
}

// WODTEM eq. (1) test; WODTEM eq. (8) test: the player of lambda. Adam's first step has the size of its learning rate.
TEST(lambda_falls_when_the_entropy_is_above_eta_and_rises_below) {
    Settings settings = tiny_settings("odt");
    set_setting(settings, "eta", "1.5");
    for (const double entropy : {1.9, 1.1}) {
        Fixture f(settings);
        Temperature& temperature = f.run.agent.temperature;
        const double before = temperature.log_lambda[0].value[0];
        update_lambda(f.compute, temperature, f.run.agent.settings, entropy);
        CHECK_CLOSE(temperature.log_lambda[0].value[0] - before, entropy > 1.5 ? -1e-4 : 1e-4, 1e-6);
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// Batches and the memory's advice

// WODTEM sec. IV-B.3, step 1 test
TEST(batches_hold_what_the_buffer_holds) {
    Settings settings = tiny_settings("wodtem");
    set_setting(settings, "context_length", "4");
    Fixture f(settings);
    const Batch batch = sample_batch(f.run, 0, static_cast<uint32_t>(f.run.agent.settings.batch_size));
    double sum = 0;
    size_t step = 0;
    for (uint32_t window = 0; window < 32; ++window) {
        const Window at = f.run.replay.sample(f.run.agent.random(Stream::batch), 0, window, 4, Sampling::uniform);
        const Trajectory& trajectory = f.run.replay.trajectories[at.trajectory];
        CHECK_EQUAL(batch.sequences.lengths[window], std::min(4, trajectory.length() - at.start));
        for (int c = 0; c < at.length; ++c, ++step) {
            const size_t t = static_cast<size_t>(at.start + c);
            CHECK_EQUAL(batch.actions[step], trajectory.actions[t]);
            CHECK_EQUAL(batch.sequences.actions[step * 8 + static_cast<size_t>(trajectory.actions[t])], 1.0f);
            CHECK_EQUAL(batch.sequences.returns_to_go[step],
                        static_cast<float>(trajectory.terminated ? 1 : 0));  // reward 1 comes last
            const double d = trajectory.terminated ? std::pow(0.99, trajectory.length() - 1 - static_cast<int>(t)) : 0;
            CHECK_CLOSE(batch.discounted_returns[step], d, 1e-12);
            sum += static_cast<double>(batch.coefficients[step]);
        }
    }
    CHECK_CLOSE(sum, 1, 1e-6);
}

TEST(normalised_states_have_mean_zero_and_deviation_one) {
    Fixture f(tiny_settings("odt"));
    double count = 0, sum[2] = {}, squares[2] = {};
    for (const Trajectory& trajectory : make_data_set(f.run.agent.settings)) {
        std::vector<float> x(trajectory.states.size());
        for (size_t i = 0; i < x.size(); i += 2) normalise(&x[i], f.run.agent.normaliser, &trajectory.states[i]);
        for (size_t i = 0; i < x.size(); ++i)
            sum[i % 2] += static_cast<double>(x[i]),
                squares[i % 2] += static_cast<double>(x[i]) * static_cast<double>(x[i]);
        count += trajectory.length();
    }
    for (const int i : {0, 1}) CHECK_CLOSE(sum[i] / count, 0, 1e-4), CHECK_CLOSE(squares[i] / count, 1, 1e-4);
}

// In the grid world epsilon 0.1 admits the very cell alone: the advice must be the best move ever made there.
// WODTEM sec. IV-B.3, step 2 test
TEST(advice_is_the_best_move_ever_made_in_the_cell) {
    Settings settings = tiny_settings("wodtem");
    set_setting(settings, "batch_size", "512");
    Fixture f(settings);
    std::map<std::pair<float, float>, std::pair<double, float>> best;  // cell -> (d, a), first to reach it
    for (const Trajectory& trajectory : offline_set(make_data_set(f.run.agent.settings), false))
        for (size_t t = 0; t < static_cast<size_t>(trajectory.length()); ++t) {
            const std::pair<float, float> cell = {trajectory.states[2 * t], trajectory.states[2 * t + 1]};
            const auto found = best.find(cell);
            if (found == best.end() || trajectory.discounted_returns[t] > found->second.first)
                best[cell] = {trajectory.discounted_returns[t], trajectory.actions[t]};
        }
    CHECK_EQUAL(f.run.memory.size(), best.size());
    Batch batch = sample_batch(f.run, 0, static_cast<uint32_t>(f.run.agent.settings.batch_size));
    consult_memory(f.run, batch);
    count_lookups(f.run, batch);
    double short_pairs = 0;
    for (size_t i = 0; i < batch.weights.size(); ++i) {
        const auto [d, a] = best.at({batch.keys[2 * i], batch.keys[2 * i + 1]});
        const bool falls_short = batch.discounted_returns[i] < d;
        CHECK_EQUAL(batch.weights[i], falls_short ? 0.75f : 1.0f);
        if (falls_short) CHECK_EQUAL(batch.advised_actions[i], a);
        short_pairs += falls_short;
    }
    CHECK_EQUAL(f.run.tally.short_pairs, short_pairs);
    CHECK(f.run.tally.unmatched_pairs == 0 && f.run.tally.pairs == 512);  // every state of the data is in the table
    CHECK(short_pairs > 0 && short_pairs < 512);
    // The dose: a quarter of each pair that falls short goes from its move to the advised one.
    std::array<double, 8> moved = {};
    double distance = 0;
    const double each = 0.25 / static_cast<double>(batch.weights.size());  // windows of one step
    for (size_t i = 0; i < batch.weights.size(); ++i) {
        if (batch.weights[i] == 1) continue;
        moved[static_cast<size_t>(batch.actions[i])] -= each;
        moved[static_cast<size_t>(batch.advised_actions[i])] += each;
        distance += batch.actions[i] != batch.advised_actions[i] ? each : 0;
    }
    CHECK_CLOSE(f.run.tally.advice, each * short_pairs, 1e-12);
    CHECK_CLOSE(f.run.tally.advice_distance, distance, 1e-12);
    for (size_t move = 0; move < 8; ++move) CHECK_CLOSE(f.run.tally.advice_shift[move], moved[move], 1e-12);
}

// Two steps with opposite advice: each moves its action by 3 and 4 tenths of the advice, together they move nothing.
TEST(advice_to_and_fro_has_a_distance_and_no_shift) {
    const EnvironmentSpec spec = {.state_dim = 1, .action_dim = 2, .discrete_actions = 0, .max_episode_steps = 1};
    Tally tally;
    const std::array<float, 2> origin = {0.5f, -0.5f}, away = {0.5f + 0.75f, -0.5f + 1.0f};
    add_advice(tally, spec, 0.25, origin.data(), away.data());
    CHECK_CLOSE(length_of_shift(tally.advice_shift, false), 0.25 * 1.25, 1e-12);
    add_advice(tally, spec, 0.25, away.data(), origin.data());
    CHECK_EQUAL(length_of_shift({0.25, 0, -0.25}, true), 0.25);  // the probability that goes from one move to another
    CHECK_EQUAL(tally.advice, 0.5);
    CHECK_CLOSE(tally.advice_distance, 0.5 * 1.25, 1e-12);
    CHECK_EQUAL(length_of_shift(tally.advice_shift, false), 0.0);
}

// Dropout off: each part has masks of its own. Sums in another order, hence not the same bits.
TEST(an_update_in_parts_is_the_update_of_the_whole_batch) {
    Settings settings = tiny_settings("wodtem");
    for (auto [name, value] : {std::pair{"dropout", "0"}, {"context_length", "3"}, {"batch_size", "500"}})
        set_setting(settings, name, value);
    Fixture whole(settings), parts(settings);
    CHECK_EQUAL(parts_of_batch(settings), 3u);
    for (Fixture* f : {&whole, &parts}) f->run.agent.temperature.log_lambda[0].value[0] = 1;  // as after many updates
    Agent& agent = whole.run.agent;
    Tape<float>& tape = whole.run.learning;
    for (int i = 0; i < 3; ++i) {
        tape.reset();
        Batch batch = sample_batch(whole.run, 0, 500);
        consult_memory(whole.run, batch);
        count_lookups(whole.run, batch);
        const Policy<float> policy = forward(tape, agent.model, batch.sequences, Queries::every_state);
        const Objective<float> result = objective(tape, policy, batch, nullptr, agent.temperature.lambda(), true);
        tape.backward(result.lagrangian);
        const double norm =
            update_parameters(whole.compute, agent.model.parameters, whole.run.optimizer, optimizer_config(settings));
        update_lambda(whole.compute, agent.temperature, settings, result.H.value[0]);
        whole.run.progress.updates += 1;

        parts.run.tally = {};
        update(parts.run);
        CHECK_CLOSE(parts.run.tally.loss, result.L.value[0], 1e-5);
        CHECK_CLOSE(parts.run.tally.entropy, result.H.value[0], 1e-5);
        CHECK_CLOSE(parts.run.tally.gradient_norm, norm, 1e-4);
        CHECK_EQUAL(parts.run.tally.pairs, static_cast<double>(batch.weights.size()));
    }
    for (size_t p = 0; p < agent.model.parameters.size(); ++p)
        for (size_t i = 0; i < agent.model.parameters[p].value.size(); ++i)
            CHECK_CLOSE(parts.run.agent.model.parameters[p].value[i], agent.model.parameters[p].value[i], 1e-4);
}

// ---------------------------------------------------------------------------------------------------------------------
// What changes from one part of a batch, one update, one episode to the next

// Each part of each update drops other elements, a tenth of them, and acting drops none: a dropped element behind the
// embedding's LayerNorm is exactly 0.
TEST(each_part_of_each_update_has_a_dropout_mask_of_its_own) {
    Settings settings = tiny_settings("odt");
    for (auto [name, value] : {std::pair{"width", "64"}, {"context_length", "3"}, {"batch_size", "500"}})
        set_setting(settings, name, value);
    Fixture f(settings);
    std::vector<std::vector<bool>> masks;
    const auto watch = [&](const std::string& name, const Tensor<float>& output) {
        if (name != "embed_ln") return;
        masks.emplace_back();  // of the first 1000 elements, which each part has
        for (size_t i = 0; i < 1000; ++i) masks.back().push_back(output.value[i] == 0);
    };
    f.run.learning.watch = watch;
    update(f.run);
    update(f.run);
    CHECK_EQUAL(masks.size(), 2 * size_t{parts_of_batch(settings)});
    for (size_t i = 0; i < masks.size(); ++i) {
        CHECK_CLOSE(static_cast<double>(std::count(masks[i].begin(), masks[i].end(), true)), 100, 50);
        for (size_t j = 0; j < i; ++j) {
            int both = 0;  // independent masks share a hundredth of the elements
            for (size_t k = 0; k < 1000; ++k) both += masks[i][k] && masks[j][k];
            CHECK(both < 50);
        }
    }
    masks.clear();
    f.run.acting.watch = [&](const std::string& name, const Tensor<float>& output) {
        for (size_t i = 0; name == "embed_ln" && i < output.size(); ++i) CHECK(output.value[i] != 0);
    };
    roll_out(f.run, GridWorld{}, Act::sample, 2, 0, 1);
}

// WODTEM sec. IV-B.3: the table takes in an online episode before the updates that follow it. One short trajectory is
// the data set, so that the episode comes through cells which the table does not know.
TEST(an_online_episode_is_remembered_before_the_next_update) {
    Settings settings = tiny_settings("wodtem");
    set_setting(settings, "data_trajectories", "1");
    set_setting(settings, "table_size", "1000");
    Fixture f(settings);
    std::map<std::pair<float, float>, double> best;  // cell -> greatest d
    const auto take_in = [&](const Trajectory& trajectory) {
        for (size_t t = 0; t < static_cast<size_t>(trajectory.length()); ++t) {
            const double d = trajectory.discounted_returns[t];
            const auto [cell, is_new] = best.insert({{trajectory.states[2 * t], trajectory.states[2 * t + 1]}, d});
            if (!is_new) cell->second = std::max(cell->second, d);
        }
    };
    for (const Trajectory& trajectory : f.run.replay.trajectories) take_in(trajectory);
    const size_t known = best.size();
    CHECK_EQUAL(f.run.memory.size(), known);
    Observer observer;
    observer.played = [&](const EpisodeRow& row) { take_in(row.trajectory); };
    observer.dropped = [](const std::string&) {};
    interact(f.run, observer);
    CHECK(best.size() > known);
    CHECK_EQUAL(f.run.memory.size(), best.size());
    for (const auto& [cell, d] : best) {
        const float state[] = {cell.first, cell.second};
        const Neighbourhoods found = f.run.memory.search(state, 1);
        CHECK(!found[0].empty());
        if (!found[0].empty()) CHECK_EQUAL(f.run.memory.e[found[0][0].entry], d);
    }
    CHECK_EQUAL(f.run.tally.rollouts, 1.0);
}

// The row of an evaluation reports the update before it: after n updates of a warm-up of 10 that is n / 10 of the rate.
TEST(the_logged_learning_rate_is_that_of_the_latest_update) {
    Fixture f(tiny_settings("odt"));
    CHECK_CLOSE(progress_row(f.run).learning_rate, 0.001, 1e-12);  // before the first update: that one's
    for (int updates = 1; updates <= 12; ++updates) {
        update(f.run);
        CHECK_CLOSE(progress_row(f.run).learning_rate, 0.01 * std::min(1.0, updates / 10.0), 1e-12);
    }
}

namespace {
// Two numbers of state and of action: the action is added to the state.
struct Wandering : Environment {
    std::array<float, 2> state = {};
    EnvironmentSpec spec() const override { return {2, 2, 0, 30}; }
    void reset(const Random&, uint64_t, float* first) override {
        state = {};
        std::copy_n(state.data(), 2, first);
    }
    Step step(const float* action, float* next) override {
        for (size_t i = 0; i < 2; ++i) next[i] = state[i] += action[i];
        return {0, false};
    }
    std::unique_ptr<Environment> clone() const override { return std::make_unique<Wandering>(*this); }
};

double correlation(const std::vector<double>& x, const std::vector<double>& y) {
    double xx = 0, yy = 0, xy = 0;
    for (size_t i = 0; i < x.size(); ++i) xx += x[i] * x[i], yy += y[i] * y[i], xy += x[i] * y[i];
    return xy / std::sqrt(xx * yy);
}
}  // namespace

// ODT sec. 3: online actions are tanh(u), u ~ N(mean, exp(log_std)^2) in each dimension by itself. 4,000 of them, taken
// apart again: standard normals, independent over dimensions, steps and episodes. 0.08 is five standard deviations.
TEST(exploration_draws_each_dimension_at_each_step_of_each_episode_from_the_policy) {
    Settings settings = tiny_settings("odt");
    Compute compute(best_kernel(), 1);
    const Run run(compute, settings, Wandering{});
    float mean[] = {0.3f, -0.2f}, log_std[] = {-1.5f, -0.5f};
    const Policy<float> policy = {Head::squashed_gaussian, {mean, nullptr, 1, 2}, {log_std, nullptr, 1, 2}};
    const Random random = {test_seed(), Stream::exploration};
    std::array<std::vector<double>, 4> z;  // two dimensions, then the same of the next step and of the next episode
    for (uint32_t t = 0; t < 4000; ++t)
        for (size_t i = 0; i < 2; ++i) {
            const auto standardised = [&](uint64_t episode, uint32_t step) {
                const float a = choose_action(run.agent, policy, 0, Act::sample, random, episode, step)[i];
                return (std::atanh(static_cast<double>(a)) - mean[i]) / std::exp(static_cast<double>(log_std[i]));
            };
            z[i].push_back(standardised(0, t));
            if (i == 0) z[2].push_back(standardised(0, t + 1));
            if (i == 0) z[3].push_back(standardised(1, t));
        }
    for (size_t i = 0; i < 2; ++i) {
        double sum = 0, squares = 0;
        for (const double x : z[i]) sum += x, squares += x * x;
        CHECK_CLOSE(sum / 4000, 0, 0.08);
        CHECK_CLOSE(squares / 4000, 1, 0.12);
    }
    for (size_t other = 1; other < 4; ++other) CHECK_CLOSE(correlation(z[0], z[other]), 0, 0.08);
    const std::vector<float> greedy = choose_action(run.agent, policy, 0, Act::greedy, random, 0, 0);
    for (size_t i = 0; i < 2; ++i) CHECK_CLOSE(greedy[i], std::tanh(mean[i]), 1e-6);
}

// The noise of H-bar belongs to the step and the update: the parts of a batch have the noise of the whole, no two steps
// share theirs, and the next update has other noise.
TEST(entropy_noise_is_drawn_for_each_step_of_each_update) {
    Settings settings = tiny_settings("odt");
    Compute compute(best_kernel(), 1);
    Run run(compute, settings, Wandering{});
    std::vector<Trajectory> data;
    for (uint64_t number = 0; number < 3; ++number) {
        Wandering environment;
        data.push_back(*random_trajectory(environment, 1, number));
        relabel(data.back(), 2, 2, settings.gamma);
    }
    begin_run(run, data);
    const std::vector<float> whole = entropy_noise(run, sample_batch(run, 0, 32));
    std::vector<float> parts = entropy_noise(run, sample_batch(run, 0, 10));
    const std::vector<float> rest = entropy_noise(run, sample_batch(run, 10, 32));
    parts.insert(parts.end(), rest.begin(), rest.end());
    CHECK_EQUAL(whole.size(), size_t{64});
    CHECK(parts == whole);
    CHECK_EQUAL(std::set<float>(whole.begin(), whole.end()).size(), whole.size());
    const Batch batch = sample_batch(run, 0, 32);
    const Random random{static_cast<uint32_t>(settings.seed), Stream::entropy_noise};
    for (uint32_t i = 0; i < 64; ++i) CHECK_EQUAL(whole[i], random.normal(0, batch.random_index[i / 2], i % 2));
    run.progress.updates += 1;
    const std::vector<float> next = entropy_noise(run, sample_batch(run, 0, 32));
    for (size_t i = 0; i < next.size(); ++i) CHECK(next[i] != whole[i]);
}

// Recorded actions may lie on the bound, where atanh is infinite.
TEST(actions_on_the_bound_enter_tokens_and_likelihood_inside_it) {
    const std::vector<float> actions = {-1, 1, 0.5f}, inside = {-1 + 1e-6f, 1 - 1e-6f, 0.5f};
    std::vector<float> token(3), target(3), move(4);
    write_action_token(token.data(), {2, 3, 0, 10}, actions.data());
    write_action(target.data(), {2, 3, 0, 10}, actions.data());
    CHECK(token == inside && target == inside);
    write_action_token(move.data(), {2, 1, 4, 10}, &actions[1]);
    CHECK(move == (std::vector<float>{0, 1, 0, 0}));
}

// ---------------------------------------------------------------------------------------------------------------------
// Acting

TEST(episodes_side_by_side_are_the_episodes_one_by_one) {
    Settings settings = tiny_settings("odt");
    set_setting(settings, "context_length", "3");
    set_setting(settings, "eval_context", "3");
    Fixture f(settings);
    const std::vector<Episode> together = roll_out(f.run, GridWorld{}, Act::sample, 2, 5, 4);
    for (uint64_t i = 0; i < 4; ++i) {
        const Trajectory alone = roll_out(f.run, GridWorld{}, Act::sample, 2, 5 + i, 1)[0].trajectory;
        CHECK(alone.actions == together[i].trajectory.actions && alone.states == together[i].trajectory.states);
    }
    CHECK(together[0].trajectory.actions != together[1].trajectory.actions);
}

TEST(sampled_actions_follow_the_policy_and_evaluation_takes_the_first_of_the_most_likely) {
    Fixture f(tiny_settings("odt"));
    float log_p[8];
    const double p[8] = {0.3, 0.05, 0.05, 0.3, 0.1, 0.1, 0.05, 0.05};
    for (int i = 0; i < 8; ++i) log_p[i] = static_cast<float>(std::log(p[i]));
    const Policy<float> policy = {Head::categorical, {log_p, nullptr, 1, 8}, {}};
    const Random random = {test_seed(), Stream::exploration};
    CHECK_EQUAL(choose_action(f.run.agent, policy, 0, Act::greedy, random, 0, 0)[0], 0.0f);
    double counts[8] = {}, chi_square = 0;
    const int n = 20000;
    for (uint32_t t = 0; t < n; ++t)
        counts[static_cast<int>(choose_action(f.run.agent, policy, 0, Act::sample, random, 1, t)[0])] += 1;
    for (int i = 0; i < 8; ++i) chi_square += (counts[i] - n * p[i]) * (counts[i] - n * p[i]) / (n * p[i]);
    CHECK(chi_square < 29.9);  // 7 degrees of freedom: exceeded once in 10,000 seeds
}

TEST(a_move_of_probability_zero_is_never_drawn) {
    const float log_p[] = {-INFINITY, 0, -INFINITY};
    for (const double uniform : {0.0, 0.5, 1 - 0x1p-53}) CHECK_EQUAL(sampled_action(log_p, 3, uniform), 1);
}

// WODTEM sec. IV-B.1: each neighbour of a look-up has been accessed, and what an episode brings that is known counts as
// matched, whether it is improved or kept.
TEST(look_ups_access_all_neighbours_and_known_states_are_matched) {
    Settings settings = tiny_settings("wodtem");
    set_setting(settings, "K", "3");
    set_setting(settings, "epsilon", "1.5");  // the cell itself and those beside it
    Fixture f(settings);
    Batch batch = sample_batch(f.run, 0, 32);
    consult_memory(f.run, batch);
    uint64_t found = 0;
    for (size_t i = 0; i < batch.neighbours.size(); ++i) found += batch.neighbours[i].size();
    const uint64_t before = f.run.memory.accesses;
    count_lookups(f.run, batch);
    CHECK(found > 32 && f.run.memory.accesses == before + found);
    Trajectory known = f.run.replay.trajectories[0];
    std::fill(known.rewards.begin(), known.rewards.end(), 10.0f);  // better than anything before
    relabel(known, 2, 1, settings.gamma);
    f.run.tally.matched = 0;
    remember(f.run, known);
    CHECK_EQUAL(f.run.tally.matched, static_cast<double>(known.length()));
}

// WODTEM eq. (6): a-hat is drawn anew in each update, by the number that belongs to the update and the step.
TEST(advice_is_drawn_by_the_numbers_of_the_update_and_the_step) {
    Settings settings = tiny_settings("wodtem");
    for (auto [name, value] : {std::pair{"K", "3"}, {"epsilon", "1.5"}, {"tau", "1e6"}})  // nearly uniform over three
        set_setting(settings, name, value);
    Fixture f(settings);
    std::vector<std::vector<float>> advised;
    Batch batch = sample_batch(f.run, 0, 32);
    for (f.run.progress.updates = 0; f.run.progress.updates < 2; ++f.run.progress.updates) {
        consult_memory(f.run, batch);
        for (uint32_t i = 0; i < 32; ++i) {  // windows of one step
            const double uniform = Random{0, Stream::advised_action}.uniform(f.run.progress.updates, i);
            if (batch.weights[i] == 1) continue;
            CHECK_EQUAL(batch.advised_actions[i], *f.run.memory.advised_action(batch.neighbours[i], uniform));
        }
        advised.push_back(batch.advised_actions);
    }
    CHECK(advised[0] != advised[1]);
}

// ODT looks nothing up: there is no share of steps that fall short, nor of those without a neighbour. DT has no lambda.
TEST(a_row_has_no_number_where_a_method_has_no_such_thing) {
    const std::vector<std::string> names = split(progress_header, ',');
    for (const char* method : {"odt", "dt"}) {
        const Settings settings = tiny_settings(method);
        Fixture f(settings);
        update(f.run);
        const std::vector<std::string> row = split(progress_line(progress_row(f.run), settings), ',');
        const auto is_nan = [&](const char* name) {
            return row.at(std::ranges::find(names, name) - names.begin()) == "nan";
        };
        for (const char* name : {"short", "unmatched", "advice"}) CHECK(is_nan(name));
        for (const char* name : {"lambda", "entropy"}) CHECK_EQUAL(is_nan(name), settings.method == "dt");
        CHECK(!is_nan("loss"));
    }
}

namespace {
// The grid world, noting the numbers of its episodes.
struct Numbered : GridWorld {
    std::vector<uint64_t> numbers;
    void reset(const Random& random, uint64_t episode, float* state) override {
        numbers.push_back(episode);
        GridWorld::reset(random, episode, state);
    }
};
}  // namespace

TEST(episodes_of_evaluations_are_numbered_apart_from_those_of_training) {
    Fixture f(tiny_settings("odt"));
    Numbered worlds[2];
    Environment* const environments[] = {&worlds[0], &worlds[1]};
    evaluate(f.run.agent, f.run.acting, environments, 6);
    CHECK(worlds[0].numbers == std::vector<uint64_t>{(uint64_t{1} << 40) + 6});
    CHECK(worlds[1].numbers == std::vector<uint64_t>{(uint64_t{1} << 40) + 7});
}

namespace {
// Adds the action to its state of one number, pays 2.5, and ends beyond 2.
struct Paying : Environment {
    float state = 0;
    EnvironmentSpec spec() const override { return {1, 1, 0, 9}; }
    void reset(const Random&, uint64_t, float* first) override { *first = state = 0; }
    Step step(const float* action, float* next) override {
        *next = state += *action;
        return {2.5, state > 2};
    }
    std::unique_ptr<Environment> clone() const override { return std::make_unique<Paying>(*this); }
};
}  // namespace

// WODTEM sec. III-B, g_{t+1} test: with rewards on the way, of which the grid world has none.
TEST(the_return_to_go_falls_by_each_reward) {
    Paying environment;
    std::vector<float> given;
    const Episode episode = play(environment, Random{0, Stream::environment}, 7, [&](Episode& running) {
        append_target(running, 10, 0.5);
        given = running.targets;
        return std::vector<float>{1};
    });
    CHECK(given == std::vector<float>({5, 3.75f, 2.5f}));
    CHECK(episode.trajectory.states == std::vector<float>({0, 1, 2}));  // before each step
    CHECK(episode.trajectory.rewards == std::vector<float>({2.5f, 2.5f, 2.5f}));
    CHECK(episode.over && episode.trajectory.terminated && episode.state[0] == 3 && episode.number == 7);
}

// WODTEM sec. III-B, g_{t+1} test: the agent is told the target less what it received; the buffer gets hindsight
// returns.
TEST(acting_is_told_the_target_less_the_rewards_so_far) {
    Settings settings = tiny_settings("odt");
    set_setting(settings, "context_length", "2");
    set_setting(settings, "eval_context", "2");
    Fixture f(settings);
    std::vector<Episode> episodes(2);
    episodes[0].state = {1, 2};
    episodes[0].targets = {2};
    episodes[1].state = {4, 5};
    episodes[1].targets = {2, 2, 1.5f};
    episodes[1].trajectory.states = {0, 0, 3, 3};
    episodes[1].trajectory.actions = {4, 1};
    episodes[1].trajectory.rewards = {0, 0.5f};
    Episode* const running[] = {&episodes[0], &episodes[1]};
    const SequenceBatch batch = acting_batch(f.run.agent, running);
    CHECK(batch.lengths == (std::vector<int>{1, 2}));
    CHECK(batch.returns_to_go == (std::vector<float>{2, 2, 1.5f}));
    CHECK(batch.timesteps == (std::vector<int>{0, 1, 2}));
    const std::vector<float> raw = {1, 2, 3, 3, 4, 5};
    std::vector<float> expected(raw.size());
    for (size_t i = 0; i < raw.size(); i += 2) normalise(&expected[i], f.run.agent.normaliser, &raw[i]);
    CHECK(batch.states == expected);
    CHECK_EQUAL(batch.actions[8 + 1], 1.0f);  // the second window's first step made move 1
    const Trajectory played = roll_out(f.run, GridWorld{}, Act::sample, 2, 0, 1)[0].trajectory;
    CHECK_EQUAL(played.returns_to_go[0], played.terminated ? 1.0 : 0.0);
}

// WODTEM Table I: g_online and g_eval are settings of their own; an online episode is numbered from 0.
TEST(online_episodes_are_told_g_online_and_evaluations_g_eval) {
    Settings settings = tiny_settings("odt");
    set_setting(settings, "g_online", "50");
    set_setting(settings, "g_eval", "-50");
    Fixture f(settings);
    for (Parameter<float>& parameter : f.run.agent.model.parameters)  // so that the fresh network heeds its target
        if (parameter.name.ends_with("c_attn.weight") || parameter.name.ends_with("c_proj.weight"))
            for (float& weight : parameter.value) weight *= 50;
    for (const Episode& episode : evaluate(f.run.agent, f.run.acting, f.run.environments.all(), 0).episodes)
        CHECK_EQUAL(episode.targets[0], -50.0f);
    const auto moves = [&](double target) {
        return roll_out(f.run, GridWorld{}, Act::sample, target, 0, 1)[0].trajectory.actions;
    };
    const std::vector<float> expected = moves(50);
    CHECK(expected != moves(-50));
    Observer observer;
    observer.played = [&](const EpisodeRow& row) { CHECK(row.trajectory.actions == expected); };
    interact(f.run, observer);
    CHECK_EQUAL(f.run.tally.rollouts, 1.0);
}

// ---------------------------------------------------------------------------------------------------------------------
// Runs

TEST(results_do_not_depend_on_the_number_of_threads) {
    const Scratch scratch;
    quiet_train(tiny_settings("wodtem"), scratch / "1");
    for (int threads = 2; threads <= 8; ++threads) {
        quiet_train(tiny_settings("wodtem"), scratch / std::to_string(threads), threads);
        check_same_results(scratch / "1", scratch / std::to_string(threads));
    }
}

// WODTEM sec. IV-B.3, step 3 test: "when alpha = 1, our method degenerates to ODT"
TEST(wodtem_with_alpha_one_is_odt_bit_for_bit) {
    const Scratch scratch;
    quiet_train(tiny_settings("odt"), scratch / "odt");
    quiet_train(tiny_settings("wodtem", "1"), scratch / "one");
    quiet_train(tiny_settings("wodtem", "0.75"), scratch / "wodtem");
    for (const char* name : {"episodes.csv", "policy.csv", "start_actions.csv"}) {
        CHECK(read_file(scratch / "odt/" + name) == read_file(scratch / "one/" + name));
        CHECK(read_file(scratch / "odt/" + name) != read_file(scratch / "wodtem/" + name));
    }
    const TensorFile odt = read_safetensors(scratch / "odt/model.safetensors"),
                     one = read_safetensors(scratch / "one/model.safetensors");
    CHECK(odt.buffer.substr(odt.data_start) == one.buffer.substr(one.data_start));
}

// The same promise, and that of being resumed, for each kind of arithmetic that this machine has.
TEST(promises_hold_in_every_arithmetic) {
    for (const Kernel* kernel : kernels) {
        if (!kernel->supported()) continue;
        const Scratch scratch;
        const auto settings = [&](const char* method, const char* alpha) {
            Settings all = tiny_settings(method, alpha);
            for (auto [name, value] : std::initializer_list<std::pair<const char*, const char*>>{
                     {"offline_updates", "5"}, {"online_steps", "150"}, {"updates_per_iteration", "1"}})
                set_setting(all, name, value);
            all.arithmetic = kernel->arithmetic();
            return all;
        };
        quiet_train(settings("odt", "1"), scratch / "odt");
        quiet_train(settings("wodtem", "1"), scratch / "one", 3);
        CHECK(read_file(scratch / "odt/policy.csv") == read_file(scratch / "one/policy.csv"));
        train_until(settings("wodtem", "1"), scratch / "stopped", 1000);
        quiet_train(settings("wodtem", "1"), scratch / "stopped");
        check_same_results(scratch / "one", scratch / "stopped");
        quiet_train(settings("wodtem", "0.75"), scratch / "wodtem");
        CHECK(read_file(scratch / "wodtem/policy.csv") != read_file(scratch / "one/policy.csv"));
    }
}

// Kills a run again and again, at any moment, with a checkpoint after each update; it must end as if nothing had been.
TEST(a_run_killed_at_any_moment_ends_with_the_same_bytes) {
    const Scratch scratch;
    quiet_train(tiny_settings("wodtem"), scratch / "whole");
    const Random random = {test_seed(), Stream::data_set};
    int kills = 0;
    for (uint32_t attempt = 0; !fs::exists(scratch / "killed/finished") && attempt < 2000; ++attempt) {
        const pid_t child = fork();
        if (child == 0) {
            quiet_train(tiny_settings("wodtem"), scratch / "killed", 1 + static_cast<int>(attempt % 2), 0);
            _exit(0);
        }
        // Later and later, so that slow machines get on and fast ones do not finish at once.
        usleep(static_cast<useconds_t>((4000 + 500 * attempt) * random.uniform(0, attempt)));
        kill(child, SIGKILL);
        int status = 0;
        waitpid(child, &status, 0);
        kills += WIFSIGNALED(status);
    }
    CHECK(kills >= 3);
    CHECK(fs::exists(scratch / "killed/finished"));
    quiet_train(tiny_settings("wodtem"),
                scratch / "killed");  // the last kill may have left a finished run's checkpoint
    check_same_results(scratch / "whole", scratch / "killed");
    CHECK(!fs::exists(scratch / "killed/checkpoint.safetensors"));
}

TEST(a_request_to_stop_saves_and_the_same_command_continues) {
    const Scratch scratch;
    quiet_train(tiny_settings("odt"), scratch / "whole");
    train_until(tiny_settings("odt"), scratch / "stopped", 1000);
    CHECK(fs::exists(scratch / "stopped/checkpoint.safetensors"));
    quiet_train(tiny_settings("odt"), scratch / "stopped");
    check_same_results(scratch / "whole", scratch / "stopped");
}

// Stops at places spread over the whole run, most of them inside an update of two parts, others inside an episode or
// an evaluation. What is saved must be what a run that is not stopped saves after the update before.
TEST(a_run_stopped_anywhere_saves_the_state_before_and_ends_with_the_same_bytes) {
    Settings settings = tiny_settings("wodtem");
    for (auto [name, value] : {std::pair{"batch_size", "700"}, {"offline_updates", "6"}, {"online_steps", "150"}})
        set_setting(settings, name, value);
    set_setting(settings, "eviction", "lru");
    set_setting(settings, "table_size", "20");
    CHECK_EQUAL(parts_of_batch(settings), 2u);
    const Scratch scratch;
    std::set<std::string> states;  // the data of all checkpoints
    const auto note_state = [&](const std::string& path) {
        const TensorFile file = read_safetensors(path);
        return states.emplace(file.data()).second;
    };
    uint64_t asked = 0;
    quiet_train(settings, scratch / "whole", 1, 0, [&] {
        const std::string path = scratch / "whole/checkpoint.safetensors";
        if (++asked % 16 == 0 && fs::exists(path)) note_state(path);  // an update asks more often than that
        return false;
    });
    CHECK(states.size() > 15);
    const Random random = {test_seed(), Stream::data_set};
    int inside = 0;
    for (uint32_t i = 0; i < 12; ++i) {
        const std::string folder = scratch / std::to_string(i), path = folder + "/checkpoint.safetensors";
        const bool two_threads = i % 4 == 0;  // of which one asks, as often as chance wills
        train_until(settings, folder, 2 + random.below(asked / (two_threads ? 8 : 1) - 1, 0, i), two_threads ? 2 : 1);
        const TensorFile file = read_safetensors(path);
        // After an evaluation, and before the first update, that run has saved nothing.
        if (file.get<double>("progress.summed_updates", {})[0] > 0) {
            CHECK(!note_state(path));
            ++inside;
        }
        quiet_train(settings, folder);
        check_same_results(scratch / "whole", folder);
    }
    CHECK(inside >= 6);
    CHECK_FAILS("run.stopped", quiet_train(settings, scratch / "none", 1, 0, [] { return true; }));
    CHECK(!fs::exists(scratch / "none"));
}

namespace {
// Sends a signal to a process that trains, when its folder has a file and some time has passed. Returns how many
// seconds of the processor's time it then took, which do not depend on what else runs there, and its exit status.
std::pair<double, int> signalled(const Settings& settings, const std::string& folder, const char* file, int signal) {
    const pid_t child = fork();
    if (child == 0) {
        std::signal(SIGHUP, SIG_DFL);  // also where the tests are started by nohup
        stop_on_signals();
        try {
            quiet_train(settings, folder);
        } catch (const Error& error) {
            _exit(error.id == "run.stopped" ? 42 : 43);
        }
        _exit(0);
    }
    clockid_t clock = 0;
    clock_getcpuclockid(child, &clock);
    const auto used = [&] {  // seconds of the child's processor time
        timespec now = {};
        clock_gettime(clock, &now);
        return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
    };
    for (int i = 0; i < 100000 && !fs::exists(folder + "/" + file); ++i) usleep(1000);
    const double at_file = used();
    for (int i = 0; i < 100000 && used() < at_file + 0.1; ++i) usleep(1000);
    const double before = used();
    kill(child, signal);
    int status = 0;
    rusage usage = {};
    wait4(child, &status, 0, &usage);
    const double seconds = static_cast<double>(usage.ru_utime.tv_sec + usage.ru_stime.tv_sec) +
                           1e-6 * static_cast<double>(usage.ru_utime.tv_usec + usage.ru_stime.tv_usec) - before;
    return {seconds, WEXITSTATUS(status)};
}
}  // namespace

// Each update here takes tens of seconds, the drawing of the second network several.
TEST(signals_end_a_run_at_once_whatever_it_is_doing) {
    const Scratch scratch;
    Settings settings = tiny_settings("wodtem");
    set_setting(settings, "width", "512");
    set_setting(settings, "batch_size", "100000");
    for (const int signal : stop_signals) {
        const std::string folder = scratch / std::to_string(signal);
        const auto [seconds, status] = signalled(settings, folder, "episodes.csv", signal);
        CHECK_EQUAL(status, 42);
        CHECK(seconds < 2);
        CHECK(fs::exists(folder + "/checkpoint.safetensors"));
    }
    set_setting(settings, "width", "1024");
    set_setting(settings, "layers", "8");
    const auto [seconds, status] = signalled(settings, scratch / "drawing", "", SIGTERM);  // the folder comes first
    CHECK_EQUAL(status, 1);
    CHECK(seconds < 1);
    CHECK(!fs::exists(scratch / "drawing/progress.csv"));

    const pid_t child = fork();
    if (child == 0) {  // as nohup starts a program
        std::signal(SIGHUP, SIG_IGN);
        stop_on_signals();
        const StopAtOnce here;
        std::raise(SIGHUP);
        _exit(stop_requested == 0 ? 42 : 43);
    }
    int child_status = 0;
    waitpid(child, &child_status, 0);
    CHECK_EQUAL(WEXITSTATUS(child_status), 42);
}

TEST(evaluation_needs_the_model_file_alone) {
    const Scratch scratch;
    quiet_train(tiny_settings("wodtem"), scratch / "run");
    const Table progress = results::Log(scratch / "run/progress.csv").table;
    fs::rename(scratch / "run/model.safetensors", scratch / "model.safetensors");
    fs::remove_all(scratch / "run");
    const TensorFile file = open_model(scratch / "model.safetensors");
    Fixture f(settings_from_text(file.text("settings"), file.path));
    f.load(scratch / "model.safetensors");
    GridWorld worlds[2];
    Environment* const environments[] = {&worlds[0], &worlds[1]};
    const Evaluation evaluation = evaluate(f.run.agent, f.run.acting, environments, 0);
    CHECK_EQUAL(number_text(evaluation.mean_length), progress.rows.back()[12]);
    CHECK_EQUAL(number_text(evaluation.mean_return), progress.rows.back()[13]);
}

// Returns of 0 and 2: mean 1, standard deviation with the divisor n - 1 the root of 2. The second episode broke down.
TEST(eval_prints_the_deviation_of_a_sample_the_moves_of_an_episode_and_how_many_were_sound) {
    std::vector<Episode> episodes(3);
    for (size_t i = 0; i < 3; ++i) {
        episodes[i].trajectory = {{0, 0, 1, 1}, {4, 7}, {0, static_cast<float>(i)}, false, {}, {}};
        relabel(episodes[i].trajectory, 2, 1, 1);
    }
    episodes[1].error = "broken";
    CHECK_EQUAL(
        printed([&] { print_evaluation(tiny_settings("odt"), episodes, 2, 1); }),
        "episode 1: length 2, return 0 R-D L-U\nwodtem: episode 2 is dropped: broken\nepisode 3: length 2, return "
        "2 R-D L-U\ngridworld, odt, seed 0: mean length 2, mean return 1 +- 1.4142135 over 2 episodes (grid world)\n");
}

TEST(the_last_line_of_a_run_and_those_of_its_progress_have_its_numbers) {
    ProgressRow row = {true, 101, 102, 3, 0.5, 0.25, 104, 5.5, 0.5, 0.5, {}};
    row.tally.loss = 3, row.tally.updates = 2;
    CHECK_EQUAL(printed([&] { print_end("a", row, tiny_settings("odt")); }),
                "a: 101 updates, 102 interactions, evaluation length 5.5, return 0.5\n");
    CHECK_EQUAL(score_text(default_settings("hopper-v2", "odt", "small"), 3234.3), ", normalised score 100");
    CHECK_EQUAL(status_text(row, 12),
                "update 101, interaction 102, loss 1.5, evaluation: length 5.5, return 0.5, 12 updates a second");
    row = {false, 101, 0, 0, 0.5, 0.25, 104, NAN, NAN, NAN, {}};
    CHECK_EQUAL(status_text(row, 12), "update 101, 12 updates a second");
}

TEST(a_row_of_an_episode_has_its_return_its_end_and_its_moves) {
    Trajectory trajectory{std::vector<float>(6), {4, 7, 0}, {0, 0, 1}, true, {}, {}};
    relabel(trajectory, 2, 1, 0.5);
    CHECK_EQUAL(episode_line({5, 12, trajectory, true}, tiny_settings("odt")), "5,12,3,1,1,470,grid world\n");
    trajectory.terminated = false;
    CHECK_EQUAL(episode_line({5, 12, trajectory, false}, tiny_settings("odt")), "5,12,3,1,0,,grid world\n");
}

TEST(every_smaller_budget_is_a_line_of_its_file) {
    const Scratch scratch;
    const RunFolder folder{scratch.path};
    Settings begun = tiny_settings("odt"), larger = begun;
    for (const int64_t steps : {500, 600, 600}) {  // the last time it was stopped before it had begun
        if (steps != larger.online_steps) begun = larger;
        larger.online_steps = steps;
        for (const char* name : {"finished", "kept.safetensors"}) write_file_atomic(folder.file(name), name);
        go_on(folder, begun, larger);
        CHECK(!folder.has("finished") && !folder.has("kept.safetensors") && folder.has("checkpoint.safetensors"));
        CHECK_EQUAL(settings_from_text(read_file(folder.file("settings")), "f").online_steps, steps);
    }
    CHECK_EQUAL(read_file(folder.file("budgets")),
                "offline_updates = 40, online_steps = 400\noffline_updates = 40, online_steps = 500\n");
}

TEST(each_of_several_runs_is_announced_by_its_number_method_and_seed) {
    const auto plan = [](const std::vector<std::string>& words) {
        return planned_runs(parse_arguments(commands[0], words));
    };
    std::vector<PlannedRun> runs = plan({"gridworld", "--methods", "dt,odt", "--seeds", "3-4", "--out", "x"});
    const char* const labels[] = {"1 of 4: DT, seed 3", "2 of 4: DT, seed 4", "3 of 4: ODT, seed 3",
                                  "4 of 4: ODT, seed 4"};
    for (size_t i = 0; i < 4; ++i) CHECK_EQUAL(runs.at(i).label, labels[i]);
    CHECK_EQUAL(plan({"gridworld"})[0].label, "WODTEM, seed 0");
    const std::string start = "4 of 4: ODT, seed 4: task ",
                      end = ", folder x/odt/seed-4; all settings: x/odt/seed-4/settings\n";
    const auto announced = [&] { return printed([&] { announce(runs[3]); }); };
    CHECK_EQUAL(announced(), start + "gridworld, preset small, data set made on the spot" + end);
    runs[3].settings.task = "hopper-v2";
    CHECK_EQUAL(announced(), start + "hopper-v2, preset small, data set none (random actions)" + end);
    runs[3].settings.dataset = "a.hdf5", runs[3].settings.dataset_path = "/b/a.hdf5";
    CHECK_EQUAL(announced(), start + "hopper-v2, preset small, data set a.hdf5" + end);
}

// 45 minutes for one seed of all methods.
TEST(a_sweep_estimates_all_its_seeds_and_passes_its_options_on) {
    const auto sweep = std::ranges::find(commands, std::string_view("sweep"), &Command::name);
    const Arguments arguments =
        parse_arguments(*sweep, {"hopper", "--methods", "dt", "--seeds", "5,8", "--clip-actions", "--estimate"});
    const std::string line = "# ./wodtem train hopper-v2 --method dt --preset small --seed ";
    CHECK_EQUAL(printed([&] { print_sweep(swept_settings(arguments), arguments, 2700); }),
                line + "5 --clip-actions\n" + line +
                    "8 --clip-actions\n# about 1.5 hours on this machine, one after the other; what is interrupted "
                    "continues\n");
}

TEST(expected_updates_are_those_of_the_schedule) {
    const Settings settings = default_settings("maze2d-umaze-v1", "odt", "reduced");  // 300 steps an episode
    CHECK_EQUAL(expected_updates(settings), 20000 + 200000.0 / 300 * 300);
    CHECK_EQUAL(expected_updates(default_settings("maze2d-umaze-v1", "dt", "small")), 12700.0);
    CHECK(CheckpointTimer{0}.due() && !CheckpointTimer{100}.due());
    StoredModel model{tiny_settings("odt")};
    ModelContents contents = model.contents();
    contents.evaluations = 4;
    model.settings.eval_episodes = 3;
    CHECK_EQUAL(first_of_last_evaluation(contents, model.settings), 9u);
}

// DT, which has no online phase, learns from random actions too.
TEST(without_a_data_set_dt_alone_has_an_offline_phase) {
    for (const char* method : {"dt", "odt", "wodtem"}) {
        Settings settings = default_settings("hopper-medium", method, "paper");
        choose_data_set(settings, "random", nullptr);
        CHECK_EQUAL(settings.offline_updates, settings.method == "dt" ? 100000 : 0);
        CHECK(settings.behaviour == "random" && (settings.online_steps == 0) == (settings.method == "dt"));
    }
}

// A replay buffer is loaded as it was saved, with the ends of its trajectories.
TEST(a_checkpoint_keeps_how_trajectories_ended) {
    Trajectory ended{{1}, {2}, {3}, true, {}, {}}, cut{{1}, {2}, {3}, false, {}, {}};
    ReplayBuffer saved{1, 1, 0.9, 5}, loaded = saved;
    for (Trajectory* trajectory : {&ended, &cut}) {
        relabel(*trajectory, 1, 1, 0.9);
        saved.add(*trajectory);
    }
    TensorFile file;
    Saver saver{file};
    visit_replay(saver, saved, 0);
    Loader loader{file};
    visit_replay(loader, loaded, 0);
    CHECK(loaded.trajectories.at(0).terminated && !loaded.trajectories.at(1).terminated);
    CHECK(loaded.trajectories[1].rewards == cut.rewards && loaded.ends == saved.ends);
}

// The sums for the log: a checkpoint keeps them, and each mean stands in the column that bears its name.
TEST(a_checkpoint_keeps_each_sum_and_a_row_has_it_in_its_column) {
    Tally saved;
    saved.loss = 3, saved.entropy = 5, saved.gradient_norm = 7, saved.updates = 2;
    saved.pairs = 4, saved.short_pairs = 1, saved.unmatched_pairs = 2;
    saved.rollout_length = 80, saved.rollout_return = 88, saved.rollouts = 8;
    saved.matched = 21, saved.evicted = 22, saved.dropped = 23, saved.advice = 9, saved.advice_distance = 11;
    saved.advice_shift = {2, 0, -2, 0, 0, 0, 0, 0};  // probability of 2 is moved
    const Settings settings = tiny_settings("wodtem");
    Fixture f(settings), g(settings);
    f.run.tally = saved;
    TensorFile file;
    Saver saver{file};
    visit_state(saver, f.run);
    Loader loader{file};
    visit_state(loader, g.run);
    const ProgressRow row = {true, 101, 102, 103, 0.5, 0.25, 104, 105, 106, 107, g.run.tally};
    std::string line = progress_line(row, settings);
    line.erase(line.find_last_not_of('\n') + 1);
    const std::vector<std::string> fields = split(line, ','), names = split(progress_header, ',');
    const std::map<std::string, std::string> expected = {
        {"phase", "online"},        {"updates", "101"},       {"interactions", "102"},
        {"episodes", "103"},        {"learning_rate", "0.5"}, {"loss", "1.5"},
        {"entropy", "2.5"},         {"lambda", "0.25"},       {"gradient_norm", "3.5"},
        {"short", "0.25"},          {"unmatched", "0.5"},     {"memory", "104"},
        {"eval_length", "105"},     {"eval_return", "106"},   {"eval_score", "107"},
        {"rollout_length", "10"},   {"rollout_return", "11"}, {"matched", "21"},
        {"evicted", "22"},          {"dropped", "23"},        {"advice", "4.5"},
        {"advice_distance", "5.5"}, {"advice_shift", "1"}};
    size_t found = 0;
    for (size_t i = 0; i < fields.size(); ++i)
        if (expected.contains(names.at(i))) found += fields[i] == expected.at(names[i]);
    CHECK_EQUAL(found, expected.size());
}

// `eval` repeats the run's last evaluation, of a finished run and of an unfinished one; another seed has other starts.
TEST(eval_is_the_runs_last_evaluation_unless_told_otherwise) {
    const Scratch scratch;
    const std::string run = scratch / "run", eval = "./wodtem eval " + run;
    const auto last_row = [&] { return results::Log(run + "/progress.csv").table.rows.back(); };
    const auto says = [&](const std::vector<std::string>& row) {
        return "mean length " + row[12] + ", mean return " + row[13] + " over 1 episode (grid world)";
    };
    train_until(tiny_settings("wodtem"), run, 2000);  // in the middle of the online phase
    CHECK(fs::exists(run + "/checkpoint.safetensors") && !fs::exists(run + "/model.safetensors"));
    check_shell(eval, 0, "run is unfinished; this is its network after ");
    check_shell(eval, 0, "gridworld, wodtem, seed 0: mean length");
    check_shell("./wodtem export --odt " + run + " " + scratch / "x.safetensors", 1, "model.safetensors");
    quiet_train(tiny_settings("wodtem"), run);
    check_shell(eval, 0, says(last_row()));
    check_shell(eval, 0, "episode 1: length " + last_row()[12] + ", return " + last_row()[13] + " ");
    check_shell(eval + " --seed 5 --episodes 3 --set g_eval=0.5 --set eval_context=1", 0, "seed 5: mean length");
    check_shell(eval + " --episodes 3", 0, "over 3 episodes");
    check_shell(eval + " --episodes 3 --record " + scratch / "made.hdf5", 0, "over 3 episodes");
    const Rows rows = read_data_set(open_hdf5(scratch / "made.hdf5"));
    CHECK_EQUAL(number_text(rows.count), number_text(3 * static_cast<int>(*to_number(last_row()[12]))));  // three alike
    CHECK(rows.state_dim == 2 && rows.action_dim == 1 && rows.ends(rows.count - 1) && rows.ends(rows.count / 3 - 1));
    CHECK_EQUAL(open_hdf5(scratch / "made.hdf5").find("actions")->type, "int32");  // so that they are read as moves
    CHECK(rows.integer_actions && number_of_moves(rows, "f") > 0);
    CHECK_EQUAL(std::count(rows.terminals.begin(), rows.terminals.end(), 1) +
                    std::count(rows.timeouts.begin(), rows.timeouts.end(), 1),
                3);
    check_shell(eval + " --record " + run + "/model.safetensors", 1, "that is read");
    check_shell(eval + " --set alpha=0.5", 2, "eval and act take --set g_eval=X and --set eval_context=N");
    check_shell(eval + " --set g_eval=x", 2, "g_eval cannot be");
    check_shell(eval + " --seed -1", 2, "nearest is 0");
}

// ---------------------------------------------------------------------------------------------------------------------
// Own data, and acting on states from outside

namespace {
// The grid world's data set as a file of own data.
std::string grid_file(const Scratch& scratch) {
    Settings settings = tiny_settings("wodtem");
    std::vector<Episode> episodes;
    for (Trajectory& trajectory : make_data_set(settings)) episodes.emplace_back().trajectory = std::move(trajectory);
    write_episodes(scratch / "own.hdf5", episodes, true);
    return scratch / "own.hdf5";
}

Settings own_settings(const std::string& path, const std::string& method) {
    Settings settings = default_settings(own_data, method, "small");
    choose_own_data(settings, path);
    for (auto [name, value] : std::initializer_list<std::pair<const char*, const char*>>{{"layers", "1"},
                                                                                         {"width", "16"},
                                                                                         {"context_length", "3"},
                                                                                         {"batch_size", "32"},
                                                                                         {"table_size", "100"},
                                                                                         {"offline_updates", "40"},
                                                                                         {"learning_rate", "0.01"},
                                                                                         {"warmup_updates", "10"}})
        set_from(settings, name, value, "command line");
    settings.arithmetic = best_kernel().arithmetic();
    return settings;
}

// Continuous data: 6 trajectories of 5 steps, 2 state and 2 action numbers. Rewards are sevenths of `reward`. With
// `beyond` the file is another one: the first action is 2, and the last trajectory does not end.
std::string continuous_file(const Scratch& scratch, float reward = 1, bool beyond = false) {
    const std::string path = scratch / (beyond ? "beyond.hdf5" : "continuous.hdf5");
    std::vector<float> states, actions, rewards;
    std::vector<uint8_t> terminals;
    for (int i = 0; i < 30; ++i) {
        const float x = static_cast<float>(i % 7) / 7;
        states.insert(states.end(), {x, 1 - x});
        actions.insert(actions.end(), {x - 0.5f, 0.25f});
        rewards.push_back(x * reward);
        terminals.push_back(i % 5 == 4);
    }
    if (beyond) actions[0] = 2, terminals.back() = 0;
    Hdf5Writer out(path);
    out.add("observations", {30, 2}, states);
    out.add("actions", {30, 2}, actions);
    out.add("rewards", {30}, rewards);
    out.add("terminals", {30}, terminals);
    out.close();
    return path;
}
}  // namespace

TEST(own_data_decide_sizes_returns_and_what_is_held_out) {
    const Scratch scratch;
    const Settings grid = own_settings(grid_file(scratch), "wodtem");
    CHECK(grid.state_dim == 2 && grid.action_dim == 1 && grid.moves == 8 && grid.eta == -1 && grid.g_eval == 1);
    const Settings continuous = own_settings(continuous_file(scratch), "odt");
    CHECK(continuous.state_dim == 2 && continuous.action_dim == 2 && continuous.moves == 0 && continuous.eta == -2);
    // Rewards are the first state number, in sevenths; the fifth trajectory, rows 20 to 24, has 6 0 1 2 3 of them.
    double best = 0;
    for (int first = 0; first < 30; first += 5) {
        double total = 0;
        for (int i = first; i < first + 5; ++i) total += static_cast<float>(i % 7) / 7;
        best = std::max(best, total);
    }
    CHECK_CLOSE(continuous.g_eval, best, 1e-6);
    CHECK_EQUAL(continuous.reward_scale, 1.0);
    for (const auto& [reward, scale] : {std::pair{3.0f, 1.0}, {40.0f, 0.01}, {0.01f, 100.0}})
        CHECK_EQUAL(own_settings(continuous_file(scratch, reward), "odt").reward_scale, scale);
    // Costs: the rewards are minus sevenths, and the best return is the least negative, that of 0 1 2 3 4 of them.
    const Settings costs = own_settings(continuous_file(scratch, -1), "odt");
    CHECK_CLOSE(costs.g_eval, -10.0 / 7, 1e-6);
    CHECK_EQUAL(costs.reward_scale, 1.0);
    // A third of six: the third and the sixth.
    Settings third = continuous;
    third.held_out = 1.0 / 3 + 1e-12;
    const auto first_states = [&](bool held_out) {
        std::vector<float> states;
        for (const Trajectory& trajectory : part_of_own_data(third, held_out)) states.push_back(trajectory.states[0]);
        return states;
    };
    const auto state = [](int row) { return static_cast<float>(row % 7) / 7; };
    CHECK(first_states(true) == (std::vector{state(10), state(25)}));
    CHECK(first_states(false) == (std::vector{state(0), state(5), state(15), state(20)}));
    CHECK_FAILS("usage.setting", check_together(default_settings(own_data, "wodtem", "small")));
    CHECK_FAILS("data.environment", make_environment(grid)->reset({}, 0, nullptr));
}

// The measurement against its definition: each window by itself, each action by hand.
TEST(held_out_measurements_are_means_over_steps) {
    const Scratch scratch;
    for (const auto& [path, method] :
         {std::pair(grid_file(scratch), "odt"), {continuous_file(scratch), "odt"}, {continuous_file(scratch), "dt"}}) {
        const Settings settings = own_settings(path, method);
        Compute compute(best_kernel(), 1);
        Run run(compute, settings, *make_environment(settings));
        begin_run(run, make_data_set(settings));
        for (int i = 0; i < 3; ++i) update(run);
        const std::vector<Trajectory> trajectories = part_of_own_data(settings, false);
        const HeldOut measured = measure(run.agent, run.acting, trajectories);
        double log_probs = 0, errors = 0, steps = 0;
        for (const Trajectory& trajectory : trajectories)
            for (int first = 0; first < trajectory.length(); first += 3) {
                const Window at = {0, first, std::min(3, trajectory.length() - first)};
                const Batch window = batch_of(run.agent, {trajectory}, {&at, 1});
                run.acting.reset();
                const Policy<float> policy =
                    forward(run.acting, run.agent.model, window.sequences, Queries::every_state);
                const int A = run.agent.spec.action_dim, columns = policy.output.columns;
                for (int i = 0; i < window.sequences.steps(); ++i, ++steps) {
                    const float* output = policy.output.value + i * columns;
                    for (int j = 0; j < A && settings.moves == 0; ++j) {
                        const double a = window.actions[i * A + j], mean = output[j];
                        const bool dt = std::string(method) == "dt";
                        const double error = std::pow((dt ? mean : std::tanh(mean)) - a, 2) / A;
                        errors += error;
                        const double deviation = dt ? 1 : std::exp(double{policy.log_std.value[i * columns + j]});
                        const double z = (std::atanh(a) - mean) / deviation;
                        log_probs +=
                            dt ? -error
                               : -z * z / 2 - std::log(deviation) - std::log(2 * M_PI) / 2 - std::log(1 - a * a);
                    }
                    if (settings.moves == 0) continue;
                    const int move = static_cast<int>(window.actions[i]);
                    log_probs += output[move];
                    errors += move != std::max_element(output, output + columns) - output;
                }
            }
        CHECK_CLOSE(measured.log_prob, log_probs / steps, 1e-6 * std::fabs(log_probs / steps) + 1e-5);
        CHECK_CLOSE(measured.error, errors / steps, 1e-5);
    }
    Fixture f(tiny_settings("odt"));
    CHECK(std::isnan(measure(f.run.agent, f.run.acting, {}).log_prob));
}

TEST(held_out_numbers_are_printed_and_logged_as_they_are_measured) {
    const Scratch scratch;
    const Settings settings = own_settings(grid_file(scratch), "odt");
    const std::string said =
        printed([&] { train(settings, scratch / "run", {.kernel = kernel_for(settings.arithmetic)}); });
    Compute compute(best_kernel(), 1);
    Run run(compute, settings, *make_environment(settings));
    ModelContents contents = contents_of(run.agent);
    load_model(contents, open_model(scratch / "run/model.safetensors"));
    const HeldOut measured = measure(run.agent, run.acting, part_of_own_data(settings, true));
    const std::string log_prob = number_text(static_cast<float>(measured.log_prob)),
                      error = number_text(static_cast<float>(measured.error));
    const std::vector<std::string> row = results::Log(scratch / "run/progress.csv").table.rows.back();
    CHECK_EQUAL(row[row.size() - 2] + " " + row.back(), log_prob + " " + error);
    CHECK(said.find("; log-probability of an action " + log_prob + ", share of other moves " + error + "\n") !=
          std::string::npos);
}

TEST(training_on_own_data_learns_and_continues_to_the_same_bytes) {
    const Scratch scratch;
    const Settings settings = own_settings(grid_file(scratch), "wodtem");
    quiet_train(settings, scratch / "whole");
    const Table progress = results::Log(scratch / "whole/progress.csv").table;
    CHECK_EQUAL(progress.rows.size(), 11u);  // before the first update, and after each tenth
    const size_t column = progress.header.size() - 2;
    CHECK_EQUAL(progress.header[column], "held_out_log_prob");
    CHECK(*to_number(progress.rows.back()[column]) > *to_number(progress.rows.front()[column]));
    CHECK(*to_number(progress.rows.back()[9]) > 0);               // some steps fall short of the memory
    for (uint64_t asked = 2; asked < 3000; asked += 1 + asked) {  // stopped anywhere, also while it measures
        const std::string parts = scratch / "parts" + std::to_string(asked);
        train_until(settings, parts, asked);
        quiet_train(settings, parts);
        for (const char* name : {"progress.csv", "model.safetensors"})
            CHECK(read_file(scratch / "whole/" + name) == read_file(parts + "/" + name));
    }
    Settings smaller = settings;
    smaller.offline_updates = 23;  // no multiple of ten: a row for each third update, and the last
    quiet_train(
        smaller, scratch / "longer", 1, 1e9, [] { return false; }, true);
    CHECK_EQUAL(results::Log(scratch / "longer/progress.csv").table.rows.size(), 9u);
    quiet_train(settings, scratch / "longer");
    CHECK(read_file(scratch / "whole/model.safetensors") == read_file(scratch / "longer/model.safetensors"));
    const std::string command = read_file(scratch / "whole/command");
    check_shell(command.substr(0, command.size() - 1) + " --out " + scratch / "again", 0, "trajectories held out");
    CHECK(read_file(scratch / "whole/model.safetensors") == read_file(scratch / "again/model.safetensors"));
    check_shell("./wodtem report " + scratch / "whole --out " + scratch / "report", 0, "log-probability, held out");
    CHECK(fs::exists(scratch / "report/data-own-moves-small-held-out.svg"));
    check_shell("./wodtem eval " + scratch / "whole", 1, "own data have no environment");
    fs::rename(settings.dataset_path, scratch / "gridworld.hdf5");  // beside the grid world, whose name it has
    quiet_train(tiny_settings("wodtem"), scratch / "grid");
    check_shell("./wodtem train " + scratch / "gridworld.hdf5 --set offline_updates=5 --out " + scratch / "named", 0,
                "5 upd");
    check_shell("./wodtem report " + scratch / "named " + scratch / "grid --out " + scratch / "both", 0,
                "data-gridworld-moves, preset");
    CHECK(read_file(scratch / "both/report.md").find(" gridworld, preset") != std::string::npos);
    fs::rename(scratch / "gridworld.hdf5", settings.dataset_path);
    check_shell("./wodtem train data", 2, "wodtem train FILE.hdf5");
    check_shell("./wodtem train " + std::string(300, 'x'), 2, "task cannot be");
    Settings narrow = settings;  // the rows of the head's weights are orthonormal
    narrow.width = 8;
    narrow.moves = 9;
    CHECK_FAILS("usage.setting", check_together(narrow));
    narrow.width = 12;
    check_together(narrow);
    check_shell("./wodtem train " + scratch / "none.hdf5", 1, "none.hdf5");
    check_shell("./wodtem train " + settings.dataset_path + " --set online_steps=5", 2, "must be 0");
    check_shell("./wodtem sweep " + settings.dataset_path + " --seeds 3", 0, "own.hdf5 --method wodtem --preset small");
}

TEST(own_data_are_read_once_for_all_runs_and_what_is_changed_or_left_out_is_said_once) {
    const Scratch scratch;
    const std::string path = continuous_file(scratch, 1, true);
    const Outcome outcome = shell("./wodtem train " + path + " --clip-actions --seeds 0-1 --methods dt,odt --out " +
                                  scratch / "runs" + " --set offline_updates=2 --set batch_size=4");
    CHECK_EQUAL(outcome.status, 0);
    for (const char* sentence : {"1 of 60 numbers of actions lay beyond 1 and were clipped\n",
                                 "of the rows, those after the last end of a trajectory are not used: 5 of 30\n"}) {
        const size_t first = outcome.text.find(sentence);
        CHECK(first != std::string::npos && outcome.text.find(sentence, first + 1) == std::string::npos);
    }
    CHECK(fs::exists(scratch / "runs/odt/seed-1/finished"));
    CHECK(outcome.text.find("2 updates; no trajectory is held out, so nothing is measured") != std::string::npos);
    CHECK(outcome.text.find("nan") == std::string::npos);
    const Settings settings = own_settings(continuous_file(scratch), "odt");
    quiet_train(settings, scratch / "with");
    fs::remove(settings.dataset_path);  // it has been read
    quiet_train(settings, scratch / "without");
    CHECK(read_file(scratch / "with/model.safetensors") == read_file(scratch / "without/model.safetensors"));
}

// Minari's files are all called main_data.hdf5: runs have names after its folders.
TEST(runs_on_folders_of_minari_are_called_after_them) {
    const Scratch scratch;
    for (const char* name : {"own/a-v0", "own/b-v0"}) {
        fs::create_directories(scratch / name + "/data");
        fs::copy_file(continuous_file(scratch), scratch / name + "/data/main_data.hdf5");
        const std::vector<PlannedRun> runs = planned_runs(parse_arguments(commands[0], {scratch / name}));
        CHECK_EQUAL(runs[0].folder, "runs/data-own-" + std::string(name).substr(4) + "-small-wodtem-0");
        CHECK_EQUAL(runs[0].settings.dataset, "own-" + std::string(name).substr(4) + ".hdf5");
    }
}

// A run that kept its state and goes on with a larger budget ends as one that had that budget from the start.
TEST(a_larger_budget_goes_on_to_the_bytes_of_a_run_that_had_it_from_the_start) {
    const Scratch scratch;
    for (const char* method : {"dt", "odt", "wodtem"}) {
        const std::string whole = scratch / method, parts = whole + "-parts";
        const Settings smaller = tiny_settings(method);
        Settings larger = smaller;
        if (std::string(method) == "dt")
            larger.offline_updates = 70;
        else
            larger.online_steps = 700;
        quiet_train(larger, whole);
        quiet_train(smaller, parts);
        CHECK_FAILS("run.not_kept", quiet_train(larger, parts));
        CHECK(fs::exists(parts + "/finished") && fs::exists(parts + "/model.safetensors"));
        fs::remove_all(parts);
        quiet_train(
            smaller, parts, 1, 1e9, [] { return false; }, true);
        const std::string model = read_file(parts + "/model.safetensors");
        quiet_train(
            smaller, parts, 1, 1e9, [] { return false; }, true);  // is finished already
        CHECK(read_file(parts + "/model.safetensors") == model && fs::exists(parts + "/kept.safetensors"));
        train_until(larger, parts, 60);  // and is stopped on the way
        CHECK(!fs::exists(parts + "/finished") && read_file(parts + "/model.safetensors") == model);
        check_shell("./wodtem eval " + parts, 0, "run is unfinished");  // not of the model of before
        check_shell("./wodtem export --odt " + parts + " " + parts + "/x", 1, "finish it");
        CHECK_FAILS("run.other_settings", quiet_train(smaller, parts));
        quiet_train(larger, parts);
        check_same_results(whole, parts);
        CHECK_EQUAL(read_file(parts + "/budgets"),
                    "offline_updates = 40, online_steps = " + std::to_string(smaller.online_steps) + "\n");
        CHECK(!fs::exists(parts + "/kept.safetensors") && !fs::exists(parts + "/checkpoint.safetensors"));
    }
}

// A model file of own data with sizes that no run can have is refused before anything of that size is allocated.
TEST(a_model_of_own_data_with_wrong_sizes_is_refused) {
    const Scratch scratch;
    quiet_train(own_settings(grid_file(scratch), "odt"), scratch / "run");
    const TensorFile file = open_model(scratch / "run");
    const Settings settings = settings_in(file);
    for (const auto& [state_dim, action_dim, moves] : {std::array<int64_t, 3>{0, 1, 8},
                                                       {2, 0, 8},
                                                       {2, 5, 8},
                                                       {2, 0, 0},
                                                       {100000, 1, 8},
                                                       {2, 100000, 0},
                                                       {2, 1, 10000}}) {
        Settings wrong = settings;
        wrong.state_dim = state_dim;
        wrong.action_dim = action_dim;
        wrong.moves = moves;
        CHECK_FAILS("model.settings", require_room(file, wrong));
    }
    require_room(file, settings);
}

// What `act` answers to the states and returns-to-go of an evaluation is what was done there.
TEST(act_answers_with_the_actions_of_an_evaluation) {
    const Scratch scratch;
    Settings settings = tiny_settings("odt");
    set_setting(settings, "context_length", "4");
    quiet_train(settings, scratch / "run");
    check_shell("./wodtem eval " + scratch / "run --episodes 2 --record " + scratch / "made.hdf5", 0, "2 episodes");
    const Rows rows = read_data_set(open_hdf5(scratch / "made.hdf5"));
    std::string states, expected;
    float wanted = 1;  // g_eval, less each reward
    for (size_t row = 0; row < rows.count; ++row) {
        states += number_text(wanted) + ", " + number_text(rows.observations[2 * row]) + "," +
                  number_text(rows.observations[2 * row + 1]) + "\r\n";
        expected += number_text(rows.actions[row]) + "\n";
        wanted = rows.ends(row) ? 1 : wanted - rows.rewards[row];
        if (rows.ends(row)) states += "\n";
    }
    write_file_atomic(scratch / "states", states);
    const std::string act = "./wodtem act " + scratch / "run ";
    CHECK_EQUAL(shell(act + scratch / "states").text, expected);
    CHECK_EQUAL(shell(act + "< " + scratch / "states").text, expected);
    CHECK_EQUAL(shell("(printf '\\357\\273\\277'; cat " + scratch / "states) | " + act).text, expected);  // of UTF-8
    check_shell("echo 1,2,3,4 | " + act, 1, "line 1 of the input has 4 numbers; expected the 2 of a state");
    check_shell("printf '0,0\\n0,x\\n' | " + act, 1, "line 2 of the input: \"x\" is not a finite number");
    check_shell("echo 1e99,0 | " + act, 1, "is not a finite number");
    check_shell("echo 3e38,1,1 | " + act, 1, "line 1 of the input: the policy has no finite answer");
    check_shell(act + scratch.path, 1, "cannot read " + scratch.path);
    check_shell(act + "< " + scratch.path, 1, "cannot read standard input");
    check_shell("(yes 1,1 | (timeout 60 " + act + "; echo status $? >&2) | head -n 2) 2>&1", 0, "status 0");
    CHECK_EQUAL(shell("printf '0,0\\n5,1,1\\n2,2\\n' | " + act).text,
                shell("printf '1,0,0\\n5,1,1\\n5,2,2\\n' | " + act).text);
    check_shell(act + scratch / "absent", 1, "cannot open");
    // A blank line begins an episode. A Gaussian's mean depends on all steps before it, so that nothing may be left.
    const Settings own = own_settings(continuous_file(scratch, 700), "odt");
    quiet_train(own, scratch / "own");
    const auto answers = [&](const std::string& lines) {
        return split(shell("printf '" + lines + "' | ./wodtem act " + scratch / "own").text, '\n');
    };
    const std::vector<std::string> twice = answers("0,1\\n0.5,0\\n\\n0,1\\n0.5,0\\n");
    CHECK(twice.size() == 5 && twice[2] == twice[0] && twice[3] == twice[1]);
    CHECK(answers("0,1\\n0.5,0\\n \\t\\n0,1\\n0.5,0\\n") == twice);  // blanks look like nothing
    const std::string alone = answers("0.5,0\\n")[0];
    CHECK(twice[1] != alone);
    CHECK(own.reward_scale == 1e-3 && own.g_eval > 1000);  // a return is given in units of the reward
    CHECK_EQUAL(answers(number_text(own.g_eval) + ",0.5,0\\n")[0], alone);
    CHECK(answers("0,0.5,0\\n")[0] != alone);
    check_shell(act + "--set alpha=0.5", 2, "eval and act take --set");
}

// WODTEM sec. IV-B.3, step 4 test; WODTEM sec. IV-B.3, step 5 test
TEST(progress_rows_keep_to_the_schedule) {
    const Scratch scratch;
    quiet_train(tiny_settings("wodtem"), scratch / "run");
    const Table progress = results::Log(scratch / "run/progress.csv").table;
    const Table episodes = results::Log(scratch / "run/episodes.csv").table;
    CHECK_EQUAL(progress.rows[0][0], "offline");
    CHECK_EQUAL(progress.rows[0][1], "40");
    size_t interactions = 0;
    for (size_t i = 0; i < episodes.rows.size(); ++i) {
        interactions += std::stoul(episodes.rows[i][2]);
        CHECK_EQUAL(episodes.rows[i][0], std::to_string(i + 1));
        CHECK_EQUAL(episodes.rows[i][1], std::to_string(interactions));
        CHECK_EQUAL(episodes.rows[i][5].size(), std::stoul(episodes.rows[i][2]));
    }
    CHECK(interactions >= 400 && interactions < 500);
    for (size_t i = 1; i < progress.rows.size(); ++i) {
        const size_t number = std::stoul(progress.rows[i][3]);
        if (i + 1 < progress.rows.size()) CHECK_EQUAL(number, 3 * i);
        CHECK_EQUAL(progress.rows[i][1], std::to_string(40 + 5 * number));  // every episode is followed by its updates
        CHECK_EQUAL(progress.rows[i][2], episodes.rows[number - 1][1]);
    }
    CHECK_EQUAL(progress.rows.back()[3], std::to_string(episodes.rows.size()));
}

// ---------------------------------------------------------------------------------------------------------------------
// Things that go wrong

TEST(a_folder_of_other_settings_is_left_alone) {
    const Scratch scratch;
    quiet_train(tiny_settings("odt"), scratch / "run");
    const std::string before = read_file(scratch / "run/model.safetensors");
    CHECK_FAILS("run.other_settings", quiet_train(tiny_settings("wodtem"), scratch / "run"));
    Settings other = tiny_settings("odt");
    set_setting(other, "g_online", "3");
    CHECK_FAILS("run.other_settings", quiet_train(other, scratch / "run"));
    CHECK(read_file(scratch / "run/model.safetensors") == before);
    quiet_train(tiny_settings("odt"), scratch / "run");  // finished already
    CHECK(read_file(scratch / "run/model.safetensors") == before);
}

TEST(a_start_that_came_to_nothing_does_not_keep_the_folder) {
    const Scratch scratch;
    fs::create_directory(scratch / "run");
    write_file_atomic(scratch / "run/settings", settings_text(tiny_settings("odt")));  // killed before the first log
    quiet_train(tiny_settings("dt"), scratch / "run");
    CHECK(fs::exists(scratch / "run/finished"));
}

TEST(two_processes_do_not_work_in_one_folder) {
    const Scratch scratch;
    fs::create_directory(scratch / "run");
    const FolderLock other(scratch / "run");
    CHECK_FAILS("run.busy", quiet_train(tiny_settings("dt"), scratch / "run"));
}

TEST(a_checkpoint_of_another_seed_is_refused) {
    const Scratch scratch;
    Settings other = tiny_settings("odt");
    other.seed = 5;
    train_until(other, scratch / "five", 1000);
    train_until(tiny_settings("odt"), scratch / "zero", 1000);
    fs::copy_file(scratch / "five/checkpoint.safetensors", scratch / "zero/checkpoint.safetensors",
                  fs::copy_options::overwrite_existing);
    CHECK_FAILS("run.other_settings", quiet_train(tiny_settings("odt"), scratch / "zero"));
}

namespace {
// Changes the bytes of a tensor, of one dimension if their number changes; write_safetensors() sums them anew.
void edit_tensor(TensorFile& file, const std::string& name, const std::function<void(std::string&)>& edit) {
    StoredTensor& tensor = file.tensors[file.index.at(name)];
    std::string bytes(file.bytes(tensor));
    edit(bytes);
    file.buffer.replace(file.data_start + tensor.begin, tensor.size, bytes);
    for (StoredTensor& later : std::span(file.tensors).subspan(file.index.at(name) + 1))
        later.begin += bytes.size() - tensor.size;
    if (bytes.size() != tensor.size) tensor.shape = {bytes.size() / about(tensor.dtype).size};
    tensor.size = bytes.size();
}
}  // namespace

TEST(a_damaged_checkpoint_or_log_is_refused_with_the_files_kept) {
    const Scratch scratch;
    train_until(tiny_settings("wodtem"), scratch / "run", 1000);
    const std::string path = scratch / "run/checkpoint.safetensors", good = read_file(path);
    for (const size_t size : {size_t{0}, size_t{7}, size_t{100}, good.size() / 2, good.size() - 1}) {
        write_file_atomic(path, std::string_view(good).substr(0, size));
        CHECK_FAILS("safetensors.truncated", quiet_train(tiny_settings("wodtem"), scratch / "run"));
    }
    std::string flipped = good;
    flipped[good.size() - 50] = static_cast<char>(flipped[good.size() - 50] ^ 4);
    write_file_atomic(path, flipped);
    CHECK_FAILS("safetensors.checksum", quiet_train(tiny_settings("wodtem"), scratch / "run"));
    CHECK(read_file(path) == flipped);

    TensorFile other = parse_safetensors(good, path);  // well-formed, but of another network
    edit_tensor(other, "model.value.embed_ln.weight", [](std::string& bytes) { bytes.resize(bytes.size() - 4); });
    write_safetensors(path, other);
    CHECK_FAILS("safetensors.shape", quiet_train(tiny_settings("wodtem"), scratch / "run"));

    write_file_atomic(path, good);
    const std::string episodes = read_file(scratch / "run/episodes.csv");
    std::string edited = episodes;
    edited[1] = 'x';
    write_file_atomic(scratch / "run/episodes.csv", edited);
    CHECK_FAILS("run.log", quiet_train(tiny_settings("wodtem"), scratch / "run"));
    write_file_atomic(scratch / "run/episodes.csv", episodes.substr(0, 3));
    CHECK_FAILS("run.log", quiet_train(tiny_settings("wodtem"), scratch / "run"));
    write_file_atomic(scratch / "run/settings", "width = 8 # half a file");
    CHECK_FAILS("settings.missing", quiet_train(tiny_settings("wodtem"), scratch / "run"));
}

namespace {

// What to do to an entry of a checkpoint, and what must be said of it.
struct Edit {
    const char* entry;
    int element;   // which gets the value; -1: the last one goes, -2: another one comes
    double value;  // rounded as the entry's type demands
    const char* error = "checkpoint.entry";
};
constexpr int shorter = -1, longer = -2;

// As a run on the grid world saves it in the online phase, with 8 moves, 20 trajectories at most and 2 state numbers.
constexpr Edit edits[] = {{"progress.advice_shift", 7, NAN},
                          {"progress.advice_shift", shorter, 0, "safetensors.shape"},
                          {"progress.advice", 0, INFINITY},
                          {"replay.actions", 0, 8},
                          {"replay.actions", 5, 1e9},
                          {"replay.actions", 1, -1},
                          {"replay.actions", 1, 3.5},
                          {"replay.actions", 1, NAN},
                          {"replay.actions", shorter, 0},
                          {"replay.states", 3, INFINITY},
                          {"replay.states", longer, 0},
                          {"replay.rewards", 0, NAN},
                          {"replay.rewards", longer, 0},
                          {"replay.lengths", 0, 0},
                          {"replay.lengths", 0, 4294967295.0},
                          {"replay.lengths", shorter, 0},
                          {"replay.lengths", longer, 0},
                          {"replay.terminated", 2, 2},
                          {"replay.terminated", shorter, 0},
                          {"replay.next", 0, 20},
                          {"memory.actions", 0, 8},
                          {"memory.actions", 1, -1},
                          {"memory.actions", 2, 0.5},
                          {"memory.keys", shorter, 0},
                          {"memory.projected", 0, NAN},
                          {"memory.e", 0, INFINITY},
                          {"memory.priority", 0, 0},
                          {"memory.priority", 0, 1e15},
                          {"memory.age", 0, 1e15},
                          {"memory.age", shorter, 0},
                          {"memory.accesses", 0, 1e19},
                          {"memory.insertions", 0, 1e15},
                          {"memory.insertions", 0, 36},
                          {"progress.online", 0, 2},
                          {"progress.updates", 0, 1e15},
                          {"progress.updates", 0, 7},
                          {"progress.interactions", 0, 1e15},
                          {"progress.episodes", 0, 1e15},
                          {"progress.evaluations", 0, 0},
                          {"progress.evaluations", 0, 1e15},
                          {"progress.next_evaluation", 0, 1},
                          {"progress.next_evaluation", 0, 1000000},
                          {"progress.eval_length", 0, INFINITY},
                          {"progress.loss", 0, NAN},
                          {"model.updates", 0, 3},
                          {"model.value.embed_ln.weight", 1, NAN},
                          {"model.first_moment.embed_ln.weight", 1, INFINITY},
                          {"model.second_moment.embed_ln.weight", 1, -1},
                          {"model.second_moment.embed_ln.weight", 0, NAN},
                          {"temperature.updates", 0, 0},
                          {"temperature.value.log_temperature", 0, -INFINITY},
                          {"temperature.value.log_temperature", 0, 1000},
                          {"normaliser.mean", 0, NAN},
                          {"normaliser.mean", shorter, 0, "safetensors.shape"},
                          {"normaliser.mean", longer, 0, "safetensors.shape"},
                          {"normaliser.deviation", 1, 0},
                          {"normaliser.deviation", longer, 0, "safetensors.shape"}};

template <class T>
void put(std::string& bytes, int element, double value) {
    const T number = static_cast<T>(value);
    std::memcpy(&bytes[static_cast<size_t>(element) * sizeof(T)], &number, sizeof(T));
}

}  // namespace

TEST(a_checkpoint_that_no_run_can_have_saved_is_refused_by_its_entry) {
    const Scratch scratch;
    const Settings settings = tiny_settings("wodtem");
    train_until(settings, scratch / "run", 20000);
    const std::string path = scratch / "run/checkpoint.safetensors", good = read_file(path);
    const auto refused = [&](const std::string& id, const std::string& entry) {
        try {
            quiet_train(settings, scratch / "run");
            report_failure(__FILE__, __LINE__, "nothing is said of " + entry);
        } catch (const Error& error) {
            const std::string sentence = error.what();
            if (error.id != id || sentence.find(path) == std::string::npos || sentence.find(entry) == std::string::npos)
                report_failure(__FILE__, __LINE__, entry + ": " + error.id + ": " + sentence);
        }
    };
    for (const Edit& edit : edits) {
        TensorFile file = parse_safetensors(good, path);
        const DType dtype = file.find(edit.entry).dtype;
        edit_tensor(file, edit.entry, [&](std::string& bytes) {
            if (edit.element == shorter) return bytes.resize(bytes.size() - about(dtype).size);
            if (edit.element == longer) return bytes.resize(bytes.size() + about(dtype).size);
            if (dtype == DType::F32) put<float>(bytes, edit.element, edit.value);
            if (dtype == DType::F64) put<double>(bytes, edit.element, edit.value);
            if (dtype == DType::U32) put<uint32_t>(bytes, edit.element, edit.value);
            if (dtype == DType::U64) put<uint64_t>(bytes, edit.element, edit.value);
        });
        write_safetensors(path, file);
        refused(edit.error, edit.entry);
    }

    // Without the two entries for checksums it would be read unchecked.
    std::string header = file_start(parse_safetensors(good, path)).substr(8);
    const size_t first = header.find("\"crc32.header\"");
    header.erase(first, header.find("\"format\"") - first);
    const uint64_t length = header.size();
    const TensorFile file = parse_safetensors(good, path);
    write_file_atomic(path, std::string(reinterpret_cast<const char*>(&length), 8) + header + std::string(file.data()));
    refused("safetensors.unchecked", "crc32.tensors");

    write_file_atomic(path, good);  // no refusal has touched anything else
    quiet_train(settings, scratch / "run");
    quiet_train(settings, scratch / "whole");
    check_same_results(scratch / "whole", scratch / "run");
}

// A table of 1e8 entries would take more than a gigabyte; a model's network alone is allocated.
TEST(a_models_table_size_costs_evaluation_nothing) {
    const Scratch scratch;
    Settings settings = tiny_settings("wodtem");
    Fixture f(settings);
    f.run.agent.settings.table_size = 100000000;
    f.save(scratch / "model.safetensors");
    const std::string limit = "(ulimit -v 900000; ./wodtem ";
    check_shell(limit + "eval " + (scratch / "model.safetensors") + " --threads 1)", 0, "mean length");
    check_shell(limit + "export --odt " + (scratch / "model.safetensors") + " " + (scratch / "odt.safetensors") + ")",
                0, "strict load_state_dict");
    check_shell(limit + "import " + (scratch / "odt.safetensors") + " " + (scratch / "back.safetensors") + ")", 0,
                "gridworld");
}

TEST(seconds_go_on_where_a_run_is_continued) {
    const Scratch scratch;
    const std::string run = scratch / "run", path = run + "/seconds.csv";
    const auto rows = [&] { return results::Log(path).table.rows; };
    const auto seconds = [&] { return results::Log(path).counts("seconds"); };  // which never fall
    train_until(tiny_settings("wodtem"), run, 20000);                           // in the online phase
    const std::vector<std::vector<std::string>> before = rows();
    CHECK_EQUAL(before[0][0] + " " + before[0][1] + " " + before[0][2], "0 0 0.000");
    CHECK(before.size() >= 2 && seconds().back() > 0);
    const std::string kept = read_file(path);
    write_file_atomic(path, kept + "999,999,9.0");  // a row that was cut off
    train_until(tiny_settings("wodtem"), run, 400);
    CHECK(read_file(path).starts_with(kept + rows()[before.size()][0] + ","));
    CHECK_EQUAL(rows()[before.size()][2], before.back()[2]);  // nothing has been done yet by the process that goes on
    write_file_atomic(path, kept + "999,999,x,d,m,p\n");
    CHECK_FAILS("run.seconds", quiet_train(tiny_settings("wodtem"), run));
    fs::remove(path);
    quiet_train(tiny_settings("wodtem"), run);
    CHECK(rows()[0][0] != "0" && rows()[0][2] == "0.000");  // counts from here on
    const Table progress = results::Log(run + "/progress.csv").table;
    CHECK_EQUAL(rows().back()[0] + " " + rows().back()[1], progress.rows.back()[1] + " " + progress.rows.back()[2]);
    CHECK(rows().back()[4].ends_with("; threads 1"));
    quiet_train(tiny_settings("wodtem"), scratch / "whole");
    check_same_results(scratch / "whole", run);
    CHECK_EQUAL(results::Log(scratch / "whole/seconds.csv").table.rows.size(), 1 + progress.rows.size());
}

TEST(seconds_of_a_process_come_on_top_of_those_before_it) {
    const Scratch scratch;
    write_file_atomic(scratch / "s", "updates,interactions,seconds,date,machine,program\n1,2,100.500,d,m,p\n");
    SecondsLog log{scratch / "s", "m"};
    log.begin(true, 3, 4);
    log.append(5, 6);
    const std::vector<double> seconds = results::Log(scratch / "s").counts("seconds");
    CHECK(seconds.size() == 3 && seconds[1] == 100.5 && seconds[2] >= 100.5 && seconds[2] < 160);
}

// A process that begins a phase at its half and makes another quarter of it in 100 seconds needs 100 more for the rest,
// and then 5 for what follows the phase.
TEST(the_time_left_follows_from_what_this_process_has_made_of_the_phase) {
    const std::string lines = printed([] {
        Console console{.terminal = false, .label = "run"};
        console.show("offline", 1, 0, [] { return "a"; });
        console.show("online", 0.5, 0, [] { return "b"; });
        console.phase_began = Clock::now() - std::chrono::seconds(100);
        console.show("online", 0.75, 5, [] { return "c"; });
    });
    CHECK_EQUAL(lines, "run, offline 100% a\nrun, online  50% b\nrun, online  75% 1:45 left, c\n");
}

TEST(saving_checkpoints_takes_at_most_a_twentieth_of_the_time) {
    CheckpointTimer timer{10};
    CHECK(!timer.due());
    timer.saved -= std::chrono::seconds(11);
    CHECK(timer.due());
    timer.save_seconds = 2;
    CHECK(!timer.due());  // 40 seconds are to pass
    timer.saved -= std::chrono::seconds(30);
    CHECK(timer.due());
    CHECK(CheckpointTimer{0}.due());
}

TEST(mean_lengths_are_exact) {
    Fixture f(tiny_settings("odt"));
    const auto mean_length = [&](size_t count) {
        std::vector<GridWorld> worlds(count);
        std::vector<Environment*> environments;
        for (GridWorld& world : worlds) environments.push_back(&world);
        return evaluate(f.run.agent, f.run.acting, environments, 0).mean_length;
    };
    CHECK_EQUAL(mean_length(11), mean_length(1));  // nothing is random: eleven times the same
}

TEST(damaged_models_are_refused) {
    const Scratch scratch;
    Fixture f(tiny_settings("odt"));
    f.save(scratch / "model.safetensors");
    f.load(scratch / "model.safetensors");
    f.run.agent.model.parameters[3].value[0] = NAN;
    f.save(scratch / "nan.safetensors");
    CHECK_FAILS("model.value", f.load(scratch / "nan.safetensors"));
    f.save_checkpoint(scratch.path);
    CHECK_FAILS("model.format", open_model(scratch / "checkpoint.safetensors"));
    CHECK_FAILS("file.open", open_model(scratch / "none.safetensors"));
}

TEST(an_impossible_folder_or_a_full_disk_is_a_sentence) {
    const Scratch scratch;
    write_file_atomic(scratch / "file", "x");
    CHECK_FAILS("run.folder", quiet_train(tiny_settings("odt"), scratch / "file/run"));
    // A limit on file sizes stands in for a full disk: the checkpoint does not fit, the logs do.
    const pid_t child = fork();
    if (child == 0) {
        std::signal(SIGXFSZ, SIG_IGN);
        const rlimit limit = {8192, 8192};
        setrlimit(RLIMIT_FSIZE, &limit);
        try {
            quiet_train(tiny_settings("wodtem"), scratch / "full", 1, 0);
        } catch (const Error& error) {
            _exit(error.id == "file.write" &&
                          std::string(error.what()).find("checkpoint.safetensors") != std::string::npos
                      ? 42
                      : 1);
        }
        _exit(0);
    }
    int status = 0;
    waitpid(child, &status, 0);
    CHECK_EQUAL(WEXITSTATUS(status), 42);
    for (const auto& entry : fs::directory_iterator(scratch / "full")) CHECK(entry.path().extension() != ".tmp");
    quiet_train(tiny_settings("wodtem"), scratch / "full");
    CHECK(fs::exists(scratch / "full/finished"));
}

TEST(numbers_that_are_not_finite_stop_the_run_and_name_the_tensor) {
    Fixture f(tiny_settings("odt"));
    f.run.agent.model.parameters.back().value[2] = INFINITY;  // a logit's bias
    CHECK_FAILS("nn.not_finite", update(f.run));
    Fixture g(tiny_settings("odt"));
    g.run.agent.model.parameters[0].gradient[1] = NAN;
    try {
        update(g.run);
        CHECK(false);
    } catch (const Error& error) {
        CHECK(std::string(error.what()).find("embed_return.weight") != std::string::npos);
    }
    // Training says at which update, and keeps what it has.
    const Scratch scratch;
    Settings settings = tiny_settings("odt");
    settings.learning_rate = 1e30;  // beyond what the command line allows
    settings.clip_norm = 0;
    settings.warmup_updates = 0;
    try {
        quiet_train(settings, scratch / "run");
        CHECK(false);
    } catch (const Error& error) {
        CHECK_EQUAL(error.id, "nn.not_finite");
        const std::string sentence = error.what();
        CHECK(sentence.find("update 2 of ") == 0 && sentence.find(scratch / "run") != std::string::npos);
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// Episodes that the physics engine spoils, and runs on the MuJoCo tasks

namespace {
// Odd episodes fail at their third step, even ones go on for five and pay 1 a step.
struct Faulty : Environment {
    uint64_t episode = 0;
    int steps = 0;
    const char* fails_with = "environment.unstable";
    EnvironmentSpec spec() const override { return GridWorld{}.spec(); }
    void reset(const Random&, uint64_t number, float* state) override {
        episode = number;
        steps = 0;
        state[0] = state[1] = 0;
    }
    Step step(const float*, float* state) override {
        if (++steps == 3 && episode % 2 == 1) fail(fails_with, "faulty: step 3: as agreed");
        state[0] = static_cast<float>(steps);
        return {1, steps == 5};
    }
    std::unique_ptr<Environment> clone() const override { return std::make_unique<Faulty>(*this); }
};
}  // namespace

TEST(episodes_whose_simulation_breaks_down_are_counted_and_used_for_nothing) {
    Settings settings = tiny_settings("wodtem");
    settings.eval_episodes = 4;
    Fixture f(settings);
    f.run.environments = Environments(Faulty{}, 4);
    std::vector<std::string> dropped;
    int played = 0;
    double evaluated_length = NAN, evaluated_return = NAN, dropped_of_row = NAN;
    Observer observer;
    observer.dropped = [&](const std::string& sentence) { dropped.push_back(sentence); };
    observer.played = [&](const EpisodeRow&) { ++played; };
    observer.pause = [](double) {};
    observer.evaluated = [&](const ProgressRow& row, const Evaluation&) {
        evaluated_length = row.eval_length;
        evaluated_return = row.eval_return;
        dropped_of_row = row.tally.dropped;
    };
    evaluate_and_report(f.run, observer);  // episodes 0 to 3 after 2^40
    CHECK_EQUAL(evaluated_length, 5.0);
    CHECK_EQUAL(evaluated_return, 5.0);
    CHECK_EQUAL(dropped_of_row, 2.0);
    CHECK(dropped.size() == 2 && dropped[0].find("an evaluation episode is dropped: faulty: step 3") == 0);
    const size_t buffered = f.run.replay.trajectories.size(), entries = f.run.memory.size();
    f.run.progress.episodes = 7;
    interact(f.run, observer);
    CHECK_EQUAL(f.run.tally.dropped, 1.0);
    CHECK_EQUAL(f.run.progress.episodes, uint64_t{8});
    CHECK_EQUAL(f.run.progress.interactions, uint64_t{3});  // they happened
    CHECK_EQUAL(f.run.replay.trajectories.size(), buffered);
    CHECK_EQUAL(f.run.memory.size(), entries);
    CHECK_EQUAL(played, 0);
    interact(f.run, observer);
    CHECK_EQUAL(f.run.progress.interactions, uint64_t{8});
    CHECK_EQUAL(played, 1);
    for (int i = 0; i < 2; ++i) interact(f.run, observer);  // one breaks down, one is sound
    CHECK(f.run.tally.rollouts == 2 && f.run.tally.rollout_length == 10 && f.run.tally.rollout_return == 10);
    const Evaluation none =
        evaluate(f.run.agent, f.run.acting, f.run.environments.first(), 1);  // episode 2^40 + 1, an odd number
    CHECK(std::isnan(none.mean_length) && std::isnan(none.mean_return));
    Faulty other;
    other.fails_with = "some.other";  // is no matter of one episode
    CHECK_FAILS("some.other", roll_out(f.run, other, Act::sample, 2, 1, 1));
}

// Faulty's first two episodes make 5 and 3 steps.
TEST(the_online_phase_ends_with_the_episode_that_reaches_the_budget) {
    for (const auto& [budget, interactions] : {std::pair<const char*, uint64_t>{"8", 8}, {"9", 13}}) {
        Settings settings = tiny_settings("odt");
        set_setting(settings, "online_steps", budget);
        Fixture f(settings);
        f.run.environments = Environments(Faulty{}, 1);
        int evaluations = 0;
        Observer observer;
        observer.dropped = [](const std::string&) {};
        observer.played = [](const EpisodeRow&) {};
        observer.pause = [](double) {};
        observer.ending = [] {};
        observer.evaluated = [&](const ProgressRow&, const Evaluation&) { ++evaluations; };
        online_phase(f.run, observer);
        CHECK_EQUAL(f.run.progress.interactions, interactions);
        CHECK_EQUAL(f.run.progress.updates, 40 + 5 * f.run.progress.episodes);
        CHECK_EQUAL(evaluations, 2);
    }
}

// Another pass over the same contexts, step by step, makes the same choices of the numbers of Stream::exploration.
TEST(a_rollout_explores_by_its_own_stream_of_random_numbers) {
    Fixture f(tiny_settings("odt"));
    const Trajectory played = roll_out(f.run, GridWorld{}, Act::sample, 2, 5, 1)[0].trajectory;
    Episode again;
    again.state = {played.states[0], played.states[1]};
    for (int t = 0; t < played.length(); ++t) {
        append_target(again, 2, f.run.agent.settings.reward_scale);
        Episode* const running[] = {&again};
        f.run.acting.reset();
        const Policy<float> policy =
            forward(f.run.acting, f.run.agent.model, acting_batch(f.run.agent, running), Queries::last_state);
        const std::vector<float> action = choose_action(
            f.run.agent, policy, 0, Act::sample, f.run.agent.random(Stream::exploration), 5, static_cast<uint32_t>(t));
        CHECK_EQUAL(action[0], played.actions[t]);
        again.trajectory.states.insert(again.trajectory.states.end(), again.state.begin(), again.state.end());
        again.trajectory.actions.push_back(played.actions[t]);
        again.trajectory.rewards.push_back(played.rewards[t]);
        again.reward = played.rewards[t];
        if (t + 1 < played.length()) again.state = {played.states[2 * t + 2], played.states[2 * t + 3]};
    }
}

// LAMB's first step of a tensor is as long as the tensor is, times the rate: theta - r (|theta| / |u|) u. Without decay
// ODT's code leaves that to lamb_always_adapt.
TEST(lamb_always_adapt_moves_each_tensor_by_the_rate_times_its_length) {
    for (const bool adapts : {true, false}) {
        Settings settings = tiny_settings("odt");
        for (auto [name, value] : {std::pair{"lamb_always_adapt", adapts ? "yes" : "no"}, {"warmup_updates", "1"}})
            set_setting(settings, name, value);
        Fixture f(settings);
        std::vector<float>& weight = f.run.agent.model.parameters[2].value;  // embed_state.weight
        const std::vector<float> before = weight;
        update(f.run);
        double moved = 0, length = 0;
        for (size_t i = 0; i < weight.size(); ++i) {
            moved += std::pow(double{weight[i]} - double{before[i]}, 2);
            length += std::pow(double{before[i]}, 2);
        }
        CHECK_EQUAL(std::fabs(std::sqrt(moved / length) - settings.learning_rate) < 1e-5, adapts);
    }
}

TEST(a_row_has_the_mean_gradient_norm_of_its_updates_and_the_entries_of_the_table) {
    Settings settings = tiny_settings("wodtem");
    set_setting(settings, "table_size", "10");
    Fixture whole(settings), parted(settings);
    update(whole.run);
    update(whole.run);
    double norms = 0;
    for (int i = 0; i < 2; ++i) {
        parted.run.tally = {};
        parted.run.tally.advice_shift.resize(8);
        update(parted.run);
        CHECK(parted.run.tally.gradient_norm > 0);
        CHECK_EQUAL(parted.run.tally.updates, 1.0);
        norms += parted.run.tally.gradient_norm;
    }
    CHECK_EQUAL(whole.run.tally.gradient_norm, norms);
    CHECK_EQUAL(whole.run.tally.updates, 2.0);
    CHECK(whole.run.memory.insertions > 10);
    CHECK_EQUAL(whole.run.tally.evicted, static_cast<double>(whole.run.memory.insertions - 10));  // by all of the data
    CHECK_EQUAL(progress_row(whole.run).memory_size, size_t{10});
}

// The map of the policy is that of an evaluation's first step, target g_eval, in each cell.
TEST(the_map_of_the_policy_is_what_an_evaluation_would_do_in_each_cell) {
    Fixture f(tiny_settings("odt"));
    for (int i = 0; i < 20; ++i) update(f.run);
    const std::vector<std::vector<float>> map = policy_by_cell(f.run, GridWorld{});
    for (int cell = 0; cell < grid_cells; ++cell) {
        Episode episode;
        episode.state = {static_cast<float>(cell / 6), static_cast<float>(cell % 6)};
        episode.targets = {1};
        Episode* const running[] = {&episode};
        f.run.acting.reset();
        const Policy<float> policy =
            forward(f.run.acting, f.run.agent.model, acting_batch(f.run.agent, running), Queries::last_state);
        for (size_t move = 0; move < 8; ++move)
            CHECK_CLOSE(map[static_cast<size_t>(cell)][move], std::exp(policy.output.value[move]), 1e-6);
    }
}

TEST(the_policy_is_written_cell_by_cell_and_that_of_the_start_beside_the_datas) {
    const Scratch scratch;
    Fixture f(tiny_settings("odt"));
    for (int i = 0; i < 20; ++i) update(f.run);
    save_grid_results(f.run, RunFolder{scratch.path});
    const std::vector<std::vector<float>> map = policy_by_cell(f.run, GridWorld{});
    const std::vector<results::MoveShares> written = results::read_policy(results::Log(scratch / "policy.csv"));
    const std::vector<double> learned = results::Log(scratch / "start_actions.csv").numbers("learned", 0, 1);
    for (size_t move = 0; move < 8; ++move) {
        for (size_t cell = 0; cell < 36; ++cell) CHECK_CLOSE(written[cell][move], map[cell][move], 1e-6);
        CHECK_CLOSE(learned[move], map[0][move], 1e-6);
    }
}

// start_actions.csv: the moves at S of the data set, and at the end of D_online, which is another by then.
TEST(moves_at_the_start_are_those_of_the_data_set_and_of_the_buffer) {
    const Scratch scratch;
    const Settings settings = tiny_settings("odt");
    Fixture f(settings);
    f.run.progress.online = 1;
    f.run.replay.trajectories = {Trajectory{{0, 0, 0, 1}, {3, 5}, {0, 0}, false, {}, {}}};
    save_grid_results(f.run, RunFolder{scratch.path});
    std::array<double, 8> made = {};
    double all = 0;
    for (const Trajectory& trajectory : make_data_set(settings))
        for (size_t t = 0; t < trajectory.actions.size(); ++t)
            if (trajectory.states[2 * t] == 0 && trajectory.states[2 * t + 1] == 0)
                made[static_cast<size_t>(trajectory.actions[t])] += 1, all += 1;
    const results::Log log(scratch / "start_actions.csv");
    for (size_t move = 0; move < 8; ++move) {
        CHECK_EQUAL(log.numbers("offline", 0, 1)[move], made[move] / all);
        CHECK_EQUAL(log.numbers("online", 0, 1)[move], move == 3 ? 1.0 : 0.0);
    }
}

// Every state of D is in the table, under the key by which a batch looks for it.
TEST(normalised_keys_find_the_states_that_the_table_took_in) {
    Settings settings = tiny_settings("wodtem");
    set_setting(settings, "keys", "normalized");
    const Fixture f(settings);
    Batch batch = sample_batch(f.run, 0, 32);
    consult_memory(f.run, batch);
    for (size_t i = 0; i < 32; ++i) {
        CHECK_EQUAL(batch.neighbours[i].size(), size_t{1});
        CHECK_EQUAL(batch.neighbours[i][0].distance, 0.0f);
    }
    CHECK_EQUAL(f.run.memory.projected[0], (0 - f.run.agent.normaliser.mean[0]) / f.run.agent.normaliser.deviation[0]);
}

TEST(a_model_says_how_many_interactions_updates_and_evaluations_made_it) {
    const Scratch scratch;
    const Settings settings = tiny_settings("odt");
    quiet_train(settings, scratch / "run");
    Fixture f(settings);
    ModelContents contents = contents_of(f.run.agent);
    load_model(contents, open_model(scratch / "run/model.safetensors"));
    const Table progress = results::Log(scratch / "run/progress.csv").table;
    CHECK_EQUAL(std::to_string(contents.updates), progress.rows.back()[1]);
    CHECK_EQUAL(std::to_string(contents.interactions), progress.rows.back()[2]);
    CHECK_EQUAL(contents.evaluations, progress.rows.size());
    f.run.progress.evaluations = 77;
    std::filesystem::create_directory(scratch / "unfinished");
    f.save_checkpoint(scratch / "unfinished");
    quietly([&] { load_model(contents, open_model_or_checkpoint(scratch / "unfinished")); });
    CHECK_EQUAL(contents.evaluations, uint64_t{77});
}

#ifdef WODTEM_MUJOCO

namespace {
Settings tiny_mujoco_settings(const std::string& task, const std::string& method) {
    Settings settings = default_settings(task, method, "small");
    for (auto [name, value] : std::initializer_list<std::pair<const char*, const char*>>{{"layers", "1"},
                                                                                         {"heads", "1"},
                                                                                         {"width", "8"},
                                                                                         {"context_length", "3"},
                                                                                         {"batch_size", "16"},
                                                                                         {"offline_updates", "5"},
                                                                                         {"updates_per_iteration", "3"},
                                                                                         {"eval_every", "2"},
                                                                                         {"eval_episodes", "3"},
                                                                                         {"warmup_updates", "10"},
                                                                                         {"data_trajectories", "3"},
                                                                                         {"behaviour", "random"},
                                                                                         {"buffer_size", "5"}})
        set_setting(settings, name, value);
    if (method != "dt") set_setting(settings, "online_steps", task.starts_with("hopper") ? "120" : "1000");
    settings.arithmetic = best_kernel().arithmetic();
    settings.mujoco = mujoco_version();
    return settings;
}
}  // namespace

// Paths count the sound episodes alone; each keeps the goal of the environment that played it.
TEST(a_path_keeps_its_own_goal_where_an_episode_before_it_is_dropped) {
    const Scratch scratch;
    const RunFolder folder{scratch.path};
    const Environments environments(MujocoEnvironment(*find_mujoco_task("antmaze-umaze"), Physics::d4rl), 2);
    std::vector<Episode> episodes(2);
    for (uint64_t i = 0; i < 2; ++i) {
        episodes[i].state.resize(29);
        environments.all()[i]->reset({test_seed(), Stream::environment}, i, episodes[i].state.data());
    }
    episodes[0].error = "broken";
    episodes[1].trajectory.states.resize(2 * 29);
    std::iota(episodes[1].trajectory.states.begin(), episodes[1].trajectory.states.end(), 0.0f);
    episodes[1].trajectory.rewards = {0, 0};
    save_maze_paths(folder, episodes, environments.all());
    const auto& goal = dynamic_cast<const MujocoEnvironment&>(*environments.all()[1]).goal;
    const std::vector<float>& state = episodes[1].state;
    CHECK_EQUAL(read_file(scratch / "paths.csv"),
                "episode,step,goal_x,goal_y,x,y\n" + csv_line(0, 0, goal[0], goal[1], 0, 1) +
                    csv_line(0, 1, goal[0], goal[1], 29, 30) + csv_line(0, 2, goal[0], goal[1], state[0], state[1]));
}

TEST(mujoco_runs_depend_on_neither_threads_nor_interruptions) {
    for (const char* task : {"hopper-v2", "maze2d-umaze-v1", "antmaze-umaze-v2"}) {
        const Scratch scratch;
        const Settings settings = tiny_mujoco_settings(task, "wodtem");
        quiet_train(settings, scratch / "1");
        quiet_train(settings, scratch / "3", 3);
        train_until(settings, scratch / "stopped", 1000, 2);
        quiet_train(settings, scratch / "stopped", 2);
        for (const char* name : {"progress.csv", "episodes.csv", "model.safetensors", "paths.csv"})
            if (fs::exists(scratch / (std::string("1/") + name)))
                for (const char* other : {"3/", "stopped/"})
                    if (read_file(scratch / (std::string("1/") + name)) !=
                        read_file(scratch / (std::string(other) + name)))
                        report_failure(__FILE__, __LINE__, std::string(task) + ": " + other + name + " differs");
        CHECK_EQUAL(fs::exists(scratch / "1/paths.csv"), std::string(task) != "hopper-v2");
        const Table progress = results::Log(scratch / "1/progress.csv").table;
        CHECK_EQUAL(progress.rows.back().back(), "d4rl on MuJoCo " + mujoco_version());
        CHECK_CLOSE(std::stod(progress.rows.back()[14]),
                    normalised_score(*find_mujoco_task(task), std::stod(progress.rows.back()[13])), 1e-9);
    }
}

TEST(a_run_on_a_collected_data_set_is_the_same_when_it_is_interrupted) {
    const Scratch scratch;
    const std::string data = scratch / "maze.hdf5";
    check_shell("./wodtem collect maze2d-umaze --steps 3000 --out " + data, 0, "3000 steps");
    check_shell("./wodtem info " + data + " --task maze2d-umaze", 0,
                "rows:         3000, 4 state and 2 action numbers");
    check_shell("./wodtem info " + data, 0, "no task");
    const std::string named = scratch / "maze2d-umaze-sparse-v1.hdf5";  // a given task goes before the name
    std::filesystem::copy_file(data, named);
    check_shell("./wodtem info " + named, 0, "(maze2d-umaze)");
    CHECK(shell("./wodtem info " + named + " --task maze2d-large").text.find("(maze2d-umaze)") == std::string::npos);
    Settings settings = tiny_mujoco_settings("maze2d-umaze-v1", "wodtem");
    set_setting(settings, "behaviour", "recorded");
    settings.dataset_path = data;
    settings.dataset_sha256 = sha256_of_file(data);
    quiet_train(settings, scratch / "whole");
    train_until(settings, scratch / "stopped", 100, 2);
    {
        const TensorFile file = read_safetensors(scratch / "stopped/checkpoint.safetensors");
        CHECK_EQUAL(file.get<uint64_t>("progress.online", {})[0], uint64_t{0});  // the buffer comes from the file again
    }
    quiet_train(settings, scratch / "stopped", 2);
    for (const char* name : {"progress.csv", "episodes.csv", "model.safetensors", "paths.csv"})
        CHECK(read_file(scratch / (std::string("whole/") + name)) ==
              read_file(scratch / (std::string("stopped/") + name)));
    const Table progress = results::Log(scratch / "whole/progress.csv").table;
    CHECK_EQUAL(progress.rows[0][0], "offline");
    CHECK(std::stod(progress.rows[0][5]) > 0);  // something was learned from
    stop_requested = 1;
    CHECK_FAILS("run.stopped", quiet_train(settings, scratch / "renamed", 2));
    stop_requested = 0;
    settings.dataset = " my set # 2\n.hdf5";  // another name for the same data: the same run
    Settings chosen = settings;
    choose_data_set(chosen, data, nullptr);  // whatever its name, it is not D4RL's
    CHECK_EQUAL(chosen.source["dataset"], "not known as a published file");
    quiet_train(settings, scratch / "renamed", 2);
    const std::vector<std::string> last = results::Log(scratch / "renamed/progress.csv").table.rows.back();
    check_shell("./wodtem eval " + (scratch / "renamed") + " --record " + (scratch / "made.hdf5"), 0,
                "mean length " + last[12] + ", mean return " + last[13] + " +-");
    check_shell("./wodtem info " + (scratch / "made.hdf5") + " --task maze2d-umaze", 0, "trajectories: 3");
    const std::string bytes = read_file(data), record = "./wodtem eval " + (scratch / "renamed") + " --record ";
    check_shell(record + data, 1, data + ": is the data set that ");
    CHECK(read_file(data) == bytes);
    check_shell(record + (scratch / "no/made.hdf5"), 1, "no/made.hdf5: its folder does not exist");
    // More episodes begin with the same ones.
    const std::string six = shell("./wodtem eval " + (scratch / "renamed") + " --episodes 6 2>/dev/null").text;
    CHECK(six.starts_with(shell("./wodtem eval " + (scratch / "renamed") + " | grep ^episode").text));
    CHECK(six.find("episode 6: ") != std::string::npos);
    settings.task = "antmaze-umaze-v2";
    CHECK_FAILS("dataset.task", quiet_train(settings, scratch / "ant"));
    CHECK(!fs::exists(scratch / "ant"));     // or a report would take it for an unfinished run
    fs::create_directory(scratch / "mine");  // what is there already is left as it is
    for (const auto& [name, id] : {std::pair("command", "run.folder"), {"settings", "settings.line"}}) {
        write_file_atomic(scratch / "mine/" + name, "mine\n");
        CHECK_FAILS(id, quiet_train(settings, scratch / "mine"));
        CHECK_EQUAL(read_file(scratch / "mine/" + name), "mine\n");
    }

    const std::string nowhere = "D4RL_DATASET_DIR=" + (scratch / "none") + " ";
    if (!fs::exists(std::string(own_folder) + "/walker2d_medium_replay-v2.hdf5"))
        check_shell(nowhere + "./wodtem train walker2d-medium-replay", 1,
                    "by: wodtem collect walker2d-medium-replay-v2");
    check_shell("./wodtem train hopper-medium --dataset " + (scratch / "none.hdf5"), 1, "none.hdf5");
    check_shell("./wodtem train maze2d-umaze --dataset README.md --out " + (scratch / "text"), 1, "README.md");
    check_shell("./wodtem collect hopper", 2, "nearest is");
    check_shell("./wodtem collect hopper-medium --policy data/policies/halfcheetah-medium.safetensors --out " +
                    (scratch / "x.hdf5"),
                1, "has 17 inputs and 6 actions, expected 11 and 3");
    check_shell("./wodtem collect hopper-medium --policy README.md --out " + (scratch / "x.hdf5"), 1, "README.md");
    check_shell("./wodtem collect hopper-medium --policy " + data + " --out " + data, 1, "that is read");
    for (const auto& entry : fs::directory_iterator(scratch.path)) CHECK(entry.path().stem() != "x");
    check_shell("./wodtem collect --help", 0, "hopper-medium-replay-v2          402000  85,000 updates of 5 ms");
    check_shell("./wodtem collect maze2d-umaze --steps 0", 2, "nearest is 1");
    for (const char* made_otherwise : {"maze2d-umaze", "hopper-medium-replay", "antmaze-walker"})
        check_shell("./wodtem collect " + std::string(made_otherwise) + " --policy /none", 2, "leave --policy out");
    check_shell("./wodtem collect antmaze-walker --steps 9", 2, "leave --steps out");
}

TEST(every_method_and_physics_trains_on_continuous_actions) {
    const Scratch scratch;
    for (const char* method : {"dt", "odt"}) quiet_train(tiny_mujoco_settings("hopper-v2", method), scratch / method);
    // Fewer episodes of the last evaluation are its first ones.
    const std::string eval = "./wodtem eval " + (scratch / "odt"), only = " | grep ^episode";
    const std::string two = shell(eval + " --episodes 2" + only).text, three = shell(eval + only).text;
    CHECK(three.starts_with(two) && three.size() > two.size() && two.starts_with("episode 1: "));
    Settings settings = tiny_mujoco_settings("hopper-v2", "odt");
    settings.physics = "2.2";
    CHECK_FAILS("run.other_settings", quiet_train(settings, scratch / "odt"));
    quiet_train(settings, scratch / "2.2");
    CHECK(read_file(scratch / "2.2/progress.csv").find("2.2 on MuJoCo") != std::string::npos);
    CHECK(read_file(scratch / "2.2/settings").find("physics = 2.2") != std::string::npos);
    const TensorFile file = open_model(scratch / "dt/model.safetensors");
    const Settings saved = settings_from_text(file.text("settings"), file.path);
    Agent agent(saved, make_environment(saved)->spec());
    ModelContents contents = contents_of(agent);
    load_model(contents, file);
    CHECK(agent.model.config.head == Head::deterministic);
}

#endif

// ---------------------------------------------------------------------------------------------------------------------
// Models in files: one made here by rule, byte by byte, with nothing of safetensors.hpp

struct MadeTensor {
    std::string name, shape;  // "[8,2]"
    size_t size;              // numbers
    float first;              // its first number, the others painted; state_std must be positive
};

// The grid world's network of width 8, one layer: names and shapes as ODT's state_dict has them (Linear [out, in], the
// GPT-2 stack's [in, out], q, k and v side by side), but for the head, which ODT has only for continuous actions.
const std::vector<MadeTensor> golden_tensors = {{"embed_return.weight", "[8,1]", 8, 0.5f},
                                                {"embed_return.bias", "[8]", 8, -0.25f},
                                                {"embed_state.weight", "[8,2]", 16, 0.5f},
                                                {"embed_state.bias", "[8]", 8, 0.5f},
                                                {"embed_action.weight", "[8,8]", 64, 0.5f},
                                                {"embed_action.bias", "[8]", 8, 0.5f},
                                                {"embed_ln.weight", "[8]", 8, 1},
                                                {"embed_ln.bias", "[8]", 8, 0},
                                                {"transformer.h.0.ln_1.weight", "[8]", 8, 1},
                                                {"transformer.h.0.ln_1.bias", "[8]", 8, 0},
                                                {"transformer.h.0.attn.c_attn.weight", "[8,24]", 192, 0.125f},
                                                {"transformer.h.0.attn.c_attn.bias", "[24]", 24, 0},
                                                {"transformer.h.0.attn.c_proj.weight", "[8,8]", 64, 0.125f},
                                                {"transformer.h.0.attn.c_proj.bias", "[8]", 8, 0},
                                                {"transformer.h.0.ln_2.weight", "[8]", 8, 1},
                                                {"transformer.h.0.ln_2.bias", "[8]", 8, 0},
                                                {"transformer.h.0.mlp.c_fc.weight", "[8,32]", 256, 0.125f},
                                                {"transformer.h.0.mlp.c_fc.bias", "[32]", 32, 0},
                                                {"transformer.h.0.mlp.c_proj.weight", "[32,8]", 256, 0.125f},
                                                {"transformer.h.0.mlp.c_proj.bias", "[8]", 8, 0},
                                                {"transformer.ln_f.weight", "[8]", 8, 1},
                                                {"transformer.ln_f.bias", "[8]", 8, 0},
                                                {"predict_action.logits.weight", "[8,8]", 64, 0.5f},
                                                {"predict_action.logits.bias", "[8]", 8, 0},
                                                {"log_temperature", "[]", 1, -2.5f},
                                                {"state_mean", "[2]", 2, 2.5f},
                                                {"state_std", "[2]", 2, 1.5f}};

uint32_t plain_crc32(const std::string& bytes) {
    uint32_t crc = ~0u;
    for (const char byte : bytes) {
        crc ^= static_cast<uint8_t>(byte);
        for (int bit = 0; bit < 8; ++bit) crc = crc >> 1 ^ (crc & 1) * 0xEDB88320u;
    }
    return ~crc;
}

std::string data_of(const MadeTensor& tensor) {
    std::string data(4 * tensor.size, '\0');
    for (size_t i = 0; i < tensor.size; ++i) {
        const float value = tensor.first + static_cast<float>(i * 37 % 251) / 128.0f;
        std::memcpy(&data[4 * i], &value, 4);
    }
    return data;
}

// The header's text, to be spoiled, and the file around it; the checksums only in a file as we write it.
std::string golden_header(const std::vector<MadeTensor>& tensors, bool checksums) {
    char digits[9];
    std::string sums, list, settings;
    size_t at = 0;
    for (const MadeTensor& tensor : tensors) {
        std::snprintf(digits, sizeof digits, "%08x", plain_crc32(data_of(tensor)));
        sums += digits;
        list += ",\"" + tensor.name + "\":{\"dtype\":\"F32\",\"shape\":" + tensor.shape + ",\"data_offsets\":[" +
                std::to_string(at) + "," + std::to_string(at + 4 * tensor.size) + "]}";
        at += 4 * tensor.size;
    }
    for (const char c : settings_text(tiny_settings("odt")))
        settings += c == '\n' ? "\\u000a" : c == '"' ? "\\\"" : std::string(1, c);
    return std::string("{\"__metadata__\":{") +
           (checksums ? "\"crc32.header\":\"00000000\",\"crc32.tensors\":\"" + sums + "\"," : "") +
           "\"evaluations\":\"67\",\"format\":\"wodtem model 1\",\"interactions\":\"345\",\"settings\":\"" + settings +
           "\",\"updates\":\"12\"}" + list + "}";
}

std::string golden_file(std::string header, const std::vector<MadeTensor>& tensors) {
    while (header.size() % 8 != 0) header += ' ';
    std::string bytes(8, '\0');
    for (size_t i = 0; i < 8; ++i) bytes[i] = static_cast<char>(header.size() >> 8 * i);
    bytes += header;
    const size_t crc = bytes.find("\"crc32.header\":\"");
    char digits[9];
    std::snprintf(digits, sizeof digits, "%08x", plain_crc32(bytes));
    if (crc != std::string::npos) bytes.replace(crc + 16, 8, digits);
    for (const MadeTensor& tensor : tensors) bytes += data_of(tensor);
    return bytes;
}

TEST(a_model_made_by_rule_is_read_and_written_back_byte_for_byte) {
    const Scratch scratch;
    const std::string golden = golden_file(golden_header(golden_tensors, true), golden_tensors);
    write_file_atomic(scratch / "golden.safetensors", golden);
    Fixture f(tiny_settings("odt"));
    ModelContents contents = contents_of(f.run.agent);
    load_model(contents, open_model(scratch / "golden.safetensors"));
    CHECK_EQUAL(contents.interactions, 345u);
    CHECK_EQUAL(contents.evaluations, 67u);
    CHECK_EQUAL(f.run.agent.model.parameters[0].value[1], 0.5f + 37.0f / 128.0f);
    save_model(contents, scratch / "back.safetensors");
    CHECK(read_file(scratch / "back.safetensors") == golden);
    check_shell("./wodtem eval " + scratch / "golden.safetensors", 0, "gridworld, odt, seed 0: mean length");
}

// Each way a model can be wrong: the sentence names the file, and the tensor or the offset.
TEST(bad_models_are_refused_with_file_tensor_and_offset) {
    const Scratch scratch;
    const std::string path = scratch / "bad.safetensors", good = golden_header(golden_tensors, false);
    Fixture f(tiny_settings("odt"));
    const auto refuses = [&](const std::string& bytes, const char* id, const std::string& part) {
        write_file_atomic(path, bytes);
        try {
            f.load(path);
            report_failure(__FILE__, __LINE__, "nothing was refused: " + part);
        } catch (const Error& error) {
            CHECK_EQUAL(error.id, id);
            for (const std::string& named : {path, part})
                if (std::string(error.what()).find(named) == std::string::npos)
                    report_failure(__FILE__, __LINE__, std::string(error.what()) + " does not say " + named);
        }
    };
    const auto spoilt = [&](const std::string& from, const std::string& to) {
        std::string header = good;
        CHECK(header.find(from) != std::string::npos);
        return golden_file(header.replace(header.find(from), from.size(), to), golden_tensors);
    };
    const std::string whole = golden_file(good, golden_tensors);
    write_file_atomic(path, whole);
    f.load(path);  // without checksums too: made elsewhere
    refuses("PK\3\4 is another magic", "safetensors.header_length", "offset 0");
    refuses(std::string("\xff\xff\xff\x7f\0\0\0\0", 8) + whole.substr(8), "safetensors.header_length", "offset 0");
    refuses(std::string("\0\0\1\0\0\0\0\0", 8) + whole.substr(8), "safetensors.truncated", "65536");
    refuses(whole.substr(0, whole.size() - 4), "safetensors.truncated", "\"state_std\"");
    refuses(whole + "1234", "safetensors.trailing", "4 bytes");
    refuses(spoilt("\"data_offsets\":[0,32]", "\"data_offsets\":[4,36]"), "safetensors.offsets",
            "\"embed_return.weight\": begins at data offset 4");
    refuses(spoilt("\"data_offsets\":[32,64]", "\"data_offsets\":[28,60]"), "safetensors.offsets", "overlap");
    refuses(spoilt("\"data_offsets\":[32,64]", "\"data_offsets\":[36,68]"), "safetensors.offsets", "hole");
    refuses(spoilt("\"data_offsets\":[32,64]", "\"data_offsets\":[64,32]"), "safetensors.offsets",
            "\"embed_return.bias\"");
    refuses(spoilt("\"F32\",\"shape\":[8,2]", "\"I64\",\"shape\":[8]"), "safetensors.dtype", "\"embed_state.weight\"");
    refuses(spoilt("\"F32\",\"shape\":[8,2]", "\"F8_E5M2\",\"shape\":[8,8]"), "safetensors.dtype", "\"F8_E5M2\"");
    refuses(spoilt("[8,2]", "[2,8]"), "safetensors.shape", "\"embed_state.weight\" has shape [2, 8], expected [8, 2]");
    refuses(spoilt("[8,2]", "[8,3]"), "safetensors.shape", "\"embed_state.weight\"");
    refuses(spoilt("\"shape\":[24]", "\"shape\":[18446744073709551615,2]"), "safetensors.shape", "c_attn.bias");
    refuses(spoilt("embed_ln.bias", "embed_ln.weight"), "safetensors.duplicate_name", "offset");
    refuses(spoilt("embed_ln.bias", "embed_ln.beta"), "model.names",
            "missing \"embed_ln.bias\"; unknown \"embed_ln.beta\"");
    refuses(spoilt("state_mean", "state_mode"), "model.names", "\"state_mode\"");
    refuses(spoilt("wodtem model 1", "wodtem model 9"), "model.format", path);
    refuses(spoilt("\"12\"}", "\"12\""), "safetensors.json", "offset");
    refuses(spoilt("layers = 1", "layers = 9"), "model.settings", "weights");
    refuses(spoilt("layers = 1", "layers = x"), "settings.value", "layers");
    std::string nan = whole;
    std::memcpy(&nan[nan.size() - 12], "\0\0\xc0\x7f", 4);
    refuses(nan, "model.value", "state_mean");
    std::string flipped = golden_file(golden_header(golden_tensors, true), golden_tensors);
    flipped[flipped.size() - 1] ^= 1;
    refuses(flipped, "safetensors.checksum", "\"state_std\"");
}

// ODT's state_dict and back. The shapes of what it never uses: its vocabulary of one, 1000 time-steps, 1024 positions.
TEST(weights_go_to_odt_and_back_byte_for_byte) {
    const Scratch scratch;
    Fixture f(tiny_settings("wodtem"));
    for (int i = 0; i < 3; ++i) update(f.run);
    f.save(scratch / "model.safetensors");
    const std::string odt = scratch / "odt.safetensors", back = scratch / "back.safetensors";
    check_shell("./wodtem export --odt " + scratch / "model.safetensors" + " " + odt, 0, "strict load_state_dict");
    const TensorFile file = read_safetensors(odt);
    for (const auto& [name, shape] :
         std::initializer_list<std::pair<const char*, Shape>>{{"transformer.wte.weight", {1, 8}},
                                                              {"embed_timestep.weight", {1000, 8}},
                                                              {"predict_state.weight", {2, 8}},
                                                              {"predict_state.bias", {2}},
                                                              {"predict_return.weight", {1, 8}},
                                                              {"predict_return.bias", {1}},
                                                              {"transformer.h.0.attn.bias", {1, 1, 1024, 1024}},
                                                              {"transformer.h.0.attn.masked_bias", {}}})
        CHECK(file.find(name).shape == shape);
    const std::vector<uint8_t> mask = file.get<uint8_t>("transformer.h.0.attn.bias", {1, 1, 1024, 1024});
    CHECK(mask[1024 * 5 + 5] == 1 && mask[1024 * 5 + 6] == 0 && mask[1024 * 1023] == 1 && mask[1023] == 0);
    CHECK_EQUAL(file.get<float>("transformer.h.0.attn.masked_bias", {})[0], -1e4f);
    CHECK(!file.has("log_temperature") && !file.has("state_mean"));  // strict loading would refuse them
    CHECK_EQUAL(file.tensors.size(), golden_tensors.size() - 3 + 8);
    check_shell("./wodtem import " + odt + " " + back, 0, "gridworld, wodtem");
    check_shell("./wodtem export --odt " + back + " " + back, 1, "that is read");
    check_shell("./wodtem import " + odt + " " + odt, 1, "that is read");
    CHECK(read_file(scratch / "model.safetensors") == read_file(back));

    // As another program would write it: no metadata; the statistics as tensors, or left to the data set.
    TensorFile plain, full;
    for (const StoredTensor& tensor : file.tensors)
        if (tensor.dtype == DType::F32)
            for (TensorFile* to : {&plain, &full})
                to->add(tensor.name, tensor.shape, file.get<float>(tensor.name, tensor.shape));
    full.add("state_mean", {2}, std::array{1.0f, 2.0f});
    full.add("state_std", {2}, std::array{3.0f, 4.0f});
    write_safetensors(scratch / "plain.safetensors", plain);
    write_safetensors(scratch / "full.safetensors", full);
    const std::string set = " --task gridworld --method wodtem --set data_trajectories=60";
    check_shell("./wodtem import " + scratch / "plain.safetensors" + " " + back, 2, "--task");
    check_shell("./wodtem import " + scratch / "plain.safetensors" + " " + back + set, 0, "gridworld, wodtem");
    Fixture other(tiny_settings("wodtem"));
    other.load(back);
    CHECK(other.run.agent.model.parameters[4].value == f.run.agent.model.parameters[4].value);
    CHECK(other.run.agent.normaliser.mean == f.run.agent.normaliser.mean);
    CHECK_EQUAL(other.run.agent.temperature.lambda(), Temperature(0.1).lambda());
    check_shell("./wodtem import " + scratch / "full.safetensors" + " " + back + set, 0, "gridworld, wodtem");
    other.load(back);
    CHECK_EQUAL(other.run.agent.normaliser.deviation[1], 4.0f);
    for (const float bad : {NAN, INFINITY, -INFINITY}) {  // statistics that are no numbers, as tensors and as text
        TensorFile spoilt = plain;
        spoilt.add("state_mean", {2}, std::array{1.0f, bad});
        spoilt.add("state_std", {2}, std::array{3.0f, 4.0f});
        write_safetensors(scratch / "spoilt.safetensors", spoilt);
        check_shell("./wodtem import " + scratch / "spoilt.safetensors" + " " + back + set, 1,
                    "tensor state_mean holds a number that is not finite");
        spoilt = plain;
        spoilt.metadata = {{"state_mean", "1 2"}, {"state_std", "3 " + number_text(bad)}};
        write_safetensors(scratch / "spoilt.safetensors", spoilt);
        check_shell("./wodtem import " + scratch / "spoilt.safetensors" + " " + back + set, 1,
                    "metadata entry state_std is not 2 finite numbers");
    }
    TensorFile twice;  // the same network in F64
    for (const StoredTensor& tensor : full.tensors) twice.add(tensor.name, tensor.shape, full.numbers(tensor));
    write_safetensors(scratch / "twice.safetensors", twice);
    const std::string before = read_file(back);
    check_shell("./wodtem import " + scratch / "twice.safetensors" + " " + back + set, 0, "gridworld, wodtem");
    CHECK(read_file(back) == before);
    check_shell("./wodtem info " + scratch / "twice.safetensors", 0, "F64 [8, 2]");
    check_shell("./wodtem import " + odt + " " + back + set + " --set layers=2", 1, "\"transformer.h.1.ln_1.weight\"");
    check_shell("./wodtem import " + odt + " " + back + set + " --set width=16", 1,
                "\"embed_return.weight\" has shape [8, 1]");
    full.add("transformer.wpe.weight", {1, 8}, std::vector<float>(8));
    write_safetensors(scratch / "full.safetensors", full);
    check_shell("./wodtem import " + scratch / "full.safetensors" + " " + back + set, 1,
                "unknown \"transformer.wpe.weight\"");
    check_shell("./wodtem export " + scratch / "model.safetensors" + " " + odt, 2, "--odt");
    check_shell("./wodtem export --odt " + scratch / "plain.safetensors" + " " + odt, 1, "no model");
    for (const char* option : {"--method dt", "--preset paper", "--set alpha=0.1", "--physics 2.2", "--dataset x"})
        check_shell("./wodtem import " + odt + " " + back + " " + option, 2, "would change nothing");
}

// Without statistics in the file, a model of recorded data takes them from the data set that it was trained on.
TEST(import_takes_missing_statistics_from_the_data_set_of_the_run) {
    const Scratch scratch;
    const std::string data = continuous_file(scratch), odt = scratch / "odt.safetensors", back = scratch / "back";
    quiet_train(own_settings(data, "odt"), scratch / "run");
    check_shell("./wodtem export --odt " + scratch / "run " + odt, 0, "strict load_state_dict");
    TensorFile file = read_safetensors(odt), bare;
    for (const StoredTensor& tensor : file.tensors)
        if (tensor.dtype == DType::F32) bare.add(tensor.name, tensor.shape, file.get<float>(tensor.name, tensor.shape));
    bare.metadata = file.metadata;
    for (const char* name : {"state_mean", "state_std", "crc32.header", "crc32.tensors"}) bare.metadata.erase(name);
    write_safetensors(odt, bare);
    const std::string import = "./wodtem import " + odt + " " + back;
    check_shell(import, 1, "has no state_mean and state_std; give the data set");
    check_shell(import + " --dataset " + continuous_file(scratch, 1, true), 1, "is not the data set of " + odt);
    check_shell(import + " --dataset " + scratch / "none.hdf5", 1, "none.hdf5");
    check_shell(import + " --task data --dataset " + data, 2, "stands in the task's place");
    check_shell(import + " --dataset " + data, 0, "data, odt");
    CHECK(read_file(back) == read_file(scratch / "run/model.safetensors"));
}

// The Gaussian head has ODT's names too.
TEST(the_gaussian_head_has_odts_names) {
    const Transformer<float> model(tiny_config(Head::squashed_gaussian, 3, 2), 1);
    std::map<std::string, Shape> shapes;
    for (const Parameter<float>& parameter : model.parameters) shapes[parameter.name] = parameter.shape;
    CHECK(shapes["predict_action.mu.weight"] == Shape({2, 8}) && shapes["predict_action.mu.bias"] == Shape({2}));
    CHECK(shapes["predict_action.log_std.weight"] == Shape({2, 8}) &&
          shapes["predict_action.log_std.bias"] == Shape({2}));
    CHECK(shapes["embed_ordering.weight"] == Shape({6, 8}) &&
          shapes["transformer.h.1.mlp.c_fc.weight"] == Shape({8, 32}));
}

TEST(a_run_can_begin_with_a_models_weights) {
    const Scratch scratch;
    Fixture f(tiny_settings("odt"));
    for (int i = 0; i < 3; ++i) update(f.run);
    f.run.agent.normaliser = {{1, 2}, {3, 4}};
    f.save(scratch / "model.safetensors");
    Settings settings = tiny_settings("wodtem");
    settings.weights_path = scratch / "model.safetensors";
    Fixture g(settings);
    for (size_t i = 0; i < f.run.agent.model.parameters.size(); ++i)
        CHECK(g.run.agent.model.parameters[i].value == f.run.agent.model.parameters[i].value);
    CHECK_EQUAL(g.run.agent.temperature.lambda(), f.run.agent.temperature.lambda());
    CHECK(g.run.agent.normaliser.mean == f.run.agent.normaliser.mean);
    CHECK_EQUAL(g.run.progress.updates, 0u);
    set_setting(settings, "heads", "2");
    CHECK_FAILS("model.settings", Fixture{settings});
    check_shell("./wodtem train gridworld --method odt --set offline_updates=1 --set online_steps=0 --weights " +
                    settings.weights_path + " --out " + scratch / "run",
                0, "1 updates");
    CHECK(read_file(scratch / "run/settings").find(sha256_of_file(settings.weights_path)) != std::string::npos);
    check_shell("./wodtem train gridworld --weights " + scratch / "run" + " --out " + scratch / "run", 1,
                "that is read");
}

// ---------------------------------------------------------------------------------------------------------------------
// Golden vectors and dumps

// Without dropout a dump is the run's own update, but for the order of sums over the parts of a batch.
TEST(a_dump_is_the_update_that_the_run_makes) {
    const Scratch scratch;
    Settings settings = tiny_settings("wodtem");
    settings.dropout = 0;
    Fixture dumped(settings), made(settings);
    for (int i = 0; i < 3; ++i) update(dumped.run), update(made.run);
    const std::string path = scratch / "dump.safetensors";
    vectors::dump_update(dumped.run, path);
    update(made.run);
    const TensorFile file = read_safetensors(path);
    for (const Parameter<float>& parameter : made.run.agent.model.parameters) {
        const std::vector<float> after = file.get<float>("update_4/out/after_1/" + parameter.name, parameter.shape);
        for (size_t i = 0; i < after.size(); ++i) CHECK_CLOSE(after[i], parameter.value[i], 2e-4);  // Adam: of 0.004
    }
    CHECK_CLOSE(file.get<float>("update_4/out/log_temperature", {1})[0],
                made.run.agent.temperature.log_lambda[0].value[0], 1e-6);
    check_shell("./wodtem check " + path, 0, "1 cases, 0 failed");

    // One number that is not what it should be is found, and named.
    for (const char* name : {"update_4/out/layer/transformer.h.0.attn", "update_4/out/gradient/embed_state.weight",
                             "update_4/out/after_1/embed_ln.bias", "update_4/out/memory/e_hat", "update_4/out/H"}) {
        TensorFile spoilt = file;
        const StoredTensor& tensor = spoilt.find(name);
        char* last = &spoilt.buffer[spoilt.data_start + tensor.begin + tensor.size - about(tensor.dtype).size];
        const double one = 1;
        const float one_float = 1;
        if (tensor.dtype == DType::F64)
            std::memcpy(last, &one, 8);
        else
            std::memcpy(last, &one_float, 4);
        write_safetensors(path, spoilt);
        check_shell("./wodtem check " + path, 1, std::string(name).substr(9));
    }
}

TEST(a_run_folder_is_dumped_at_its_first_update_or_its_next) {
    const Scratch scratch;
    quiet_train(tiny_settings("odt"), scratch / "run");
    const std::string path = scratch / "dump.safetensors";
    check_shell("./wodtem check --dump " + path + " --run " + scratch / "run", 0, "update 1, ");
    check_shell("./wodtem check " + path, 0, "1 cases, 0 failed");
    Fixture f(tiny_settings("odt"));
    for (int i = 0; i < 2; ++i) update(f.run);
    fs::create_directory(scratch / "unfinished");
    write_file_atomic(scratch / "unfinished/settings", settings_text(f.run.agent.settings));
    f.save_checkpoint(scratch / "unfinished");
    check_shell("./wodtem check --dump " + path + " --run " + scratch / "unfinished", 0, "update 3, ");
    check_shell("./wodtem check " + path, 0, "1 cases, 0 failed");
    CHECK(fs::exists(scratch / "unfinished/checkpoint.safetensors"));
    for (const char* input : {"settings", "checkpoint.safetensors"})
        check_shell("./wodtem check --dump " + scratch / "unfinished/" + input + " --run " + scratch / "unfinished", 1,
                    "that is read");
    check_shell("./wodtem check --dump " + path, 2, "--run DIR");
    check_shell("./wodtem check", 2, "vector files");
    check_shell("./wodtem check --dump " + path + " --run " + scratch / "nothing", 1, "nothing/settings");
}

// ---------------------------------------------------------------------------------------------------------------------
// The command line, through the program itself

TEST(bad_usage_exits_with_two_and_names_the_nearest) {
    check_shell("./wodtem", 2, "wodtem COMMAND --help");
    check_shell("./wodtem --help", 0, "report");
    check_shell("./wodtem train --help", 0, "updates_per_iteration");
    check_shell("./wodtem help train", 0, "updates_per_iteration");
    check_shell("./wodtem train --help", 0, "width                    8 ");  // the value that would be used
    check_shell("./wodtem tasks gridworld --preset=paper", 0, "width = 512");
    check_shell("./wodtem --version", 0, "wodtem model 1; commit ");
    check_shell("./wodtem --version", 0, "; wodtem checkpoint 2; g++ ");
    check_shell("./wodtem train gridworld --lr 0.1", 2,
                "has no option \"--lr\" (wodtem train --help); a setting is given");
    check_shell("./wodtem reprot", 2, "the nearest is \"report\"");
    check_shell("./wodtem jump", 2, "unknown command \"jump\" (wodtem --help lists all)");
    check_shell("./wodtem sweep --estimate=yes", 2, "takes no value");
    // A reader that has seen enough is no failure; a full disk is one (below).
    check_shell("({ ./wodtem sweep --seeds 0-9999; echo status $? >&2; } | head -1)", 0, "status 0");
    check_shell("./wodtem trian gridworld", 2, "nearest is \"train\"");
    check_shell("./wodtem train gridwrold", 2, "nearest is \"gridworld\"");
    check_shell("./wodtem train gridworld --metod odt", 2, "nearest is \"--method\"");
    check_shell("./wodtem train gridworld --method odd", 2, "nearest is \"odt\"");
    check_shell("./wodtem train gridworld --seed -1", 2, "nearest is 0");
    check_shell("./wodtem train gridworld --seed 1 --seed 2", 2, "given twice");
    check_shell("./wodtem train gridworld --seed", 2, "needs a value");
    check_shell("./wodtem train gridworld --out --set alpha=1", 2, "needs a value");
    check_shell("./wodtem train gridworld --seed 1 --seeds 0-4", 2, "choose one");
    check_shell("./wodtem train hoper", 2, "nearest is \"hopper-v2\"");
    check_shell("./wodtem train hopper --dataset random --physics 2.3", 2, "none|d4rl|2.2");
    check_shell("./wodtem train hopper --dataset random --physics none", 2, "d4rl or 2.2");
    check_shell("./wodtem train gridworld --physics 2.2", 2, "cannot have physics");
    check_shell("./wodtem train hopper --dataset random --set behaviour=left_down", 2, "it is recorded or random");
    check_shell("./wodtem trace gridworld", 2, "MuJoCo");
    check_shell("./wodtem trace nothing", 2, "\"nothing\"");
    check_shell("./wodtem trace hopper --physics old", 2, "none|d4rl|2.2");
    check_shell("./wodtem train gridworld --set alpha=2", 2, "nearest is 1");
    check_shell("./wodtem train gridworld --set alhpa=1", 2, "nearest is \"alpha\"");
    check_shell("./wodtem train gridworld --set alpha", 2, "NAME=VALUE");
    check_shell("./wodtem train gridworld --set width=15 --set heads=2", 2, "nearest width is 16");
    check_shell("./wodtem train gridworld --kernel sse9", 2, "portable");
    check_shell("./wodtem train gridworld --method odt --methods dt,odt", 2, "choose one");
    check_shell("./wodtem train gridworld --methods dt,odd", 2, "nearest is \"odt\"");
    check_shell("./wodtem train gridworld --threads 1000", 2, "nearest is 256");
    check_shell("./wodtem train", 2, "TASK");
    check_shell("./wodtem sweep --seeds 4-0", 2, "range");
    check_shell("./wodtem sweep --seeds 1,1", 2, "given twice");
    check_shell("./wodtem sweep --methods odt,,dt", 2, "method cannot be");
    check_shell("./wodtem train gridworld --seeds ''", 2, "not empty");
    check_shell("./wodtem train -h", 0, "updates_per_iteration");
    check_shell("(ulimit -v 2000000; ./wodtem train gridworld --threads 256 --out /tmp/wodtem-no-threads)", 1,
                "threads");
    fs::remove_all("/tmp/wodtem-no-threads");
}

TEST(info_shows_d4rls_own_figures_of_a_file_of_this_name) {
    const Scratch scratch;
    const std::string path = scratch / "hopper_medium-v2.hdf5";
    Hdf5Writer out(path);
    out.add("observations", {2, 11}, std::vector<float>(22));
    out.add("actions", {2, 3}, std::vector<float>(6));
    out.add("rewards", {2}, std::vector<float>(2));
    out.add("terminals", {2}, std::vector<uint8_t>{0, 1});
    out.close();
    check_shell("./wodtem info " + path, 0,
                "D4RL's: 2186 trajectories, returns: mean 1422.06, deviation 378.95, 315.87 to 3222.36\n");
}

// A pipe that nobody writes to, and 4 GB that a file system need not store, under names of both kinds.
TEST(info_refuses_a_pipe_by_its_kind_and_useless_gigabytes_by_their_first_bytes) {
    const Scratch scratch;
    for (const char* name : {"pipe", "pipe.hdf5"}) {
        CHECK_EQUAL(mkfifo((scratch / name).c_str(), 0600), 0);
        for (const char* command : {"info ", "check "})
            check_shell(std::string("timeout 10 ./wodtem ") + command + (scratch / name), 1, "not a regular file");
    }
    const std::string small = "(ulimit -v 900000; ./wodtem info ";
    for (const auto& [name, start, sentence] : {std::tuple("huge", "", "offset 8: expected {"),
                                                {"huge.hdf5", "", "not an HDF5 file"},
                                                {"huge_empty", "{}", "bytes follow the last tensor"}}) {
        std::string first(8, '\0');
        first[0] = static_cast<char>(std::strlen(start));
        write_file_atomic(scratch / name, first + start);
        fs::resize_file(scratch / name, uint64_t{1} << 32);
        check_shell(small + (scratch / name) + ")", 1, sentence);
    }
}

TEST(failures_exit_with_one_and_a_sentence) {
    const Scratch scratch;
    check_shell("./wodtem eval " + (scratch / "none"), 1, scratch / "none");
    write_file_atomic(scratch / "text", "not a model at all");
    check_shell("./wodtem info " + (scratch / "text"), 1, "text");
    check_shell("./wodtem report " + (scratch / "none") + " --out " + (scratch / "out"), 1, "none");
    check_shell("./wodtem train gridworld --out /proc/none", 1, "/proc/none");
    check_shell("(./wodtem tasks > /dev/full)", 1, "stdout");
    check_shell("./wodtem tasks", 0, "gridworld");
    for (const auto& [task, dataset] : {std::pair("hopper-medium", "hopper_medium-v2.hdf5"), {"hopper", "none"}}) {
        const std::string text = shell(std::string("./wodtem tasks ") + task).text;
        const Settings settings = settings_from_text(text, "tasks");
        CHECK_EQUAL(settings.dataset, dataset);
        CHECK(settings.mujoco == mujoco_version() && settings.source.at("dataset").find("--dataset") < 60);
        CHECK(text.starts_with("# Decided by options") && text.find("\ntask = ") < text.find("# Settings for --set") &&
              text.find("\nlayers = ") > text.find("# Settings for --set"));
    }
    check_shell("./wodtem tasks " + grid_file(scratch), 0, "moves = 8 ");
    check_shell("./wodtem eval " + scratch / "own.hdf5", 1, "is an HDF5 file, so a data set (see wodtem info)");
    check_shell("./wodtem train hopper", 1, "--dataset random");
    check_shell("./wodtem train gridworld --dataset x.hdf5", 2, "makes its own data set");
    check_shell("./wodtem sweep --precision fp16", 2, "--precision");
    check_shell(
        "./wodtem sweep hopper --seeds 3 --methods dt --dataset 'my set' --set width=8 --precision bf16 --kernel "
        "portable",
        0,
        "./wodtem train hopper-v2 --method dt --preset small --seed 3 --dataset 'my set' --kernel portable "
        "--precision bf16 --set width=8\n");
    check_shell("./wodtem sweep --seeds 0-1 --methods odt,wodtem", 0,
                "train gridworld --method wodtem --preset small --seed 1");
}

#ifdef WODTEM_MUJOCO

TEST(an_evaluation_names_the_library_that_ran_and_counts_its_sound_episodes) {
    const Scratch scratch;
    Settings settings = tiny_mujoco_settings("maze2d-umaze-v1", "odt");
    settings.mujoco = "0.0.1";  // of the machine where the model was trained
    Agent agent(settings, spec_of(settings));
    agent.normaliser = {{0, 0, 0, 0}, {1, 1, 1, 1}};
    save_model(contents_of(agent), scratch / "model.safetensors");
    check_shell("./wodtem eval " + (scratch / "model.safetensors") + " --episodes 2", 0,
                "over 2 episodes (d4rl on MuJoCo " + mujoco_version() + ")");
}

#endif

#ifdef WODTEM_MUJOCO

TEST(trace_answers_line_by_line_and_refuses_what_it_cannot_read) {
    const std::string start = "init qpos,0.5,0.5\ninit qvel,0,6\n";
    const auto trace_of = [](const std::string& task, const std::string& lines) {
        return shell("(printf '" + lines + "' | ./wodtem trace " + task + " 2>/dev/null)").text;
    };
    // Free flight: 6 m/s is clipped to 5; a = (100 - v) / (m + 0.01), v' = v + 0.01 a, x' = x + 0.01 v'.
    const double m = 4.188790204786391, vx = 0.01 * 100 / (m + 0.01), vy = 5 + 0.01 * -5 / (m + 0.01);
    const std::string text = trace_of("maze2d-large", "init qpos,3,0.9\ninit qvel,0,6\n2,0\n");
    CHECK(text.starts_with("init obs,3,0.90000000000000002,0,6\n"));
    std::vector<double> row;
    for (const std::string& part : split(text.substr(text.find('\n') + 1), ',')) row.push_back(std::stod(part));
    CHECK_EQUAL(row.size(), size_t{6});
    const double expected[6] = {3 + 0.01 * vx, 0.9 + 0.01 * vy, vx, vy, 0, 0};
    for (size_t i = 0; i < row.size(); ++i) CHECK_CLOSE(row[i], expected[i], 1e-12);
    CHECK_EQUAL(trace_of("maze2d-large", "init qpos,3,0.9\r\ninit qvel,0,6\r\n2,0\r\n"), text);  // as on Windows
    CHECK_EQUAL(trace_of("maze2d-umaze", start + "0,0\n" + start + "0,0\n"),
                trace_of("maze2d-umaze", start + "0,0\n") + trace_of("maze2d-umaze", start + "0,0\n"));
    CHECK(trace_of("maze2d-umaze", "goal,0.5,0.5\n" + start + "0,0\n").ends_with(",1,0\n"));
    CHECK(trace_of("maze2d-umaze", "goal,3,3\n" + start + "0,0\n").ends_with(",0,0\n"));

    const auto refuses = [&](const std::string& task, const std::string& lines, const std::string& part) {
        check_shell("printf '" + lines + "' | ./wodtem trace " + task, 1, part);
    };
    refuses("maze2d-umaze", "0,0\n", "line 1 ");
    refuses("maze2d-umaze", "init qpos,1\n", "2 finite numbers");
    refuses("maze2d-umaze", "init qpos,1,1\n0,0\n", "line 2 ");
    refuses("maze2d-umaze", "init qpos,1,1\n", "init qvel");
    refuses("maze2d-umaze", start + "0,0,0\n", "line 3 ");
    refuses("maze2d-umaze", start + "0,nan\n", "finite");
    refuses("maze2d-umaze", start + "0,inf\n", "finite");
    refuses("maze2d-umaze", start + "0,1e999\n", "finite");
    refuses("maze2d-umaze", start + "\n", "line 3 ");
    refuses("maze2d-umaze", start + "0,0x\n", "line 3 ");
    refuses("maze2d-umaze", "goal,1\n", "goal, and 2");
    refuses("hopper", "goal,1,1\n", "no maze");
    refuses("hopper", "init qpos,0,1.25,0,0,0,0\ninit qvel,1e12,0,0,0,0,0\n0,0,0\n", "step 1: MuJoCo");
    CHECK(!fs::exists("MUJOCO_LOG.TXT"));
}

#endif

// What `make fuzz` has found, and its seeds: each file of tests/fuzz goes to the target that its name begins with. So do
// files that a run makes, whole and with a byte changed.
TEST(inputs_of_the_fuzz_targets_end_in_a_value_or_an_error) {
    std::vector<std::pair<std::string, std::string>> inputs;  // target and bytes
    for (const auto& entry : fs::directory_iterator("tests/fuzz")) {
        const std::string name = entry.path().filename();
        inputs.emplace_back(name.substr(0, name.find('-')), read_file(entry.path()));
    }
    CHECK(inputs.size() >= 4);
    const Scratch scratch;
    Settings settings = tiny_settings("wodtem");
    for (const auto& [name, value] : {std::pair("eval_episodes", "2"), {"offline_updates", "2"}})
        set_setting(settings, name, value);
    settings.online_steps = 200;
    uint64_t asked = 0;
    CHECK_FAILS("run.stopped", quiet_train(settings, scratch / "run", 1, 0, [&] { return ++asked > 40; }));
    const std::string checkpoint = read_file(scratch / "run/checkpoint.safetensors");
    quiet_train(settings, scratch / "run");
    const std::string model = read_file(scratch / "run/model.safetensors");
    std::string report;
    for (const char* file : {"settings", "progress.csv", "episodes.csv", "policy.csv", "start_actions.csv"})
        report += read_file(scratch / ("run/" + std::string(file))) + '\0';
    for (const char* target : {"safetensors", "model", "import"}) inputs.emplace_back(target, model);
    for (const char* name : {"root_old", "root_latest", "shared", "peers_latest"})
        inputs.emplace_back("hdf5", hdf5_bytes(name));
    inputs.emplace_back("checkpoint", checkpoint);
    inputs.emplace_back("report", report);
    inputs.emplace_back("settings", settings_text(settings));

    const Random random{test_seed(), 100};
    for (size_t i = 0; i < inputs.size(); ++i) {
        const auto& [target, whole] = inputs[i];
        for (uint32_t change = 0; change <= 30; ++change) {
            std::string bytes = whole;  // the first time as it is
            const auto at = static_cast<size_t>(random.uniform(i, change) * static_cast<double>(bytes.size()));
            if (change > 0 && !bytes.empty())
                bytes[at] = static_cast<char>(static_cast<int>(random.uniform(i, change + 100) * 256));
            std::string id;
            try {
                quietly([&] { fuzz::run_target(target, bytes); });
            } catch (const Error& error) {
                id = error.id;
            } catch (const std::exception& other) {
                report_failure(__FILE__, __LINE__, target + ", change " + std::to_string(change) + ": " + other.what());
            }
            if (change == 0 && target != "hdf5") CHECK_EQUAL(id, "");  // those hold more than a data set, or less
        }
    }
    fs::remove_all(fuzz::scratch());
}

// For test_vectors.cpp, which does not include wodtem.cpp.
int run_command_line(const std::vector<std::string>& words) { return run_command_line(commands, words); }
