// wodtem.cpp: weighting online decision transformer with episodic memory: the method, and the command line around it.
//
// In order: settings (Tables I and II and the per-dataset table, each value with its source); the agent and all training
// state; batches and the memory's advice, eqs. (4) to (7); the objective and its two steps, eqs. (1) to (3) and (8) to
// (10); acting and evaluation, sec. III-B; the run folder; the offline and the online phase, sec. IV-B.3; the command
// line; main.
// One code path serves three methods: DT is the likelihood alone, offline alone; ODT adds the entropy constraint and the
// online phase; WODTEM adds the memory, and with alpha = 1 it is ODT bit for bit.
// Promises: a run is a function of its settings: the same bytes for any number of threads, in one go or continued.
// Leaves out: how data sets come about (data/).

#include <sys/file.h>
#include <sys/ioctl.h>
#include <unistd.h>

#include <chrono>
#include <csignal>
#include <filesystem>
#include <functional>
#include <iostream>
#include <map>
#include <numeric>
#include <optional>
#include <set>
#include <variant>

#include "data/collect.hpp"
#include "data/d4rl.hpp"
#include "data/report.hpp"
#include "data/safetensors.hpp"
#include "gridworld.hpp"
#include "memory.hpp"
#include "mujoco_env.hpp"
#include "nn.hpp"

// ---------------------------------------------------------------------------------------------------------------------
// Settings. The initial values are the paper's grid world; `setting_rows` gives each one's range and source, and
// `task_rows` what the other tasks change.

struct Settings {
    std::string task = "gridworld", method = "wodtem", preset = "small", arithmetic = "fused";
    std::string physics = "none", mujoco = "none", dataset = "none", dataset_sha256 = "none", first_weights = "none";
    int64_t seed = 0;

    int64_t layers = 1, heads = 1, width = 512, context_length = 1, eval_context = 5;
    bool position = false;
    double dropout = 0.1;

    std::string optimizer = "lamb";
    double learning_rate = 1e-3, weight_decay = 0, clip_norm = 0.25;
    bool lamb_always_adapt = false;
    int64_t warmup_updates = 10000, batch_size = 256, offline_updates = 1000, updates_per_iteration = 50;

    double initial_lambda = 0.1, lambda_learning_rate = 1e-4, eta = -1;

    int64_t online_steps = 20000, buffer_size = 500, eval_episodes = 1, eval_every = 10;
    double g_online = 2, g_eval = 1, reward_scale = 1;
    bool keep_lowest = false;

    double gamma = 0.99, alpha = 0.75, epsilon = 0.1, tau = 1;
    int64_t K = 1, projected_dim = 0, table_size = 36;
    std::string keys = "raw", eviction = "lfu";
    bool exclude_self = false;

    std::string behaviour = "right_down", edge = "clipped", state_encoding = "coordinates";
    int64_t data_trajectories = 500, data_seed = default_data_seed;

    std::map<std::string, std::string> source;  // of values that do not come from the table: name -> where from
    std::string dataset_path, weights_path;  // where they are on this machine; no settings: a run may go on elsewhere
};

using Field = std::variant<bool Settings::*, int64_t Settings::*, double Settings::*, std::string Settings::*>;

struct SettingRow {
    const char* name;
    Field field;
    double low, high;     // of numbers, inclusive
    const char* choices;  // of words, separated by |
    const char* source;   // of the grid world's value
};

constexpr const char* task_names =
    "gridworld|hopper-medium-v2|hopper-medium-replay-v2|walker2d-medium-v2|walker2d-medium-replay-v2|"
    "halfcheetah-medium-v2|halfcheetah-medium-replay-v2|ant-medium-v2|ant-medium-replay-v2|antmaze-umaze-v2|"
    "antmaze-umaze-diverse-v2|maze2d-umaze-v1|maze2d-medium-v1|maze2d-large-v1|hopper-v2|walker2d-v2|halfcheetah-v2|"
    "ant-v2";
constexpr double many = 1e9;
// WODTEM Table I: each row is the source of a value below.
inline const SettingRow setting_rows[] = {
    {"task", &Settings::task, 0, 0, task_names, "command line"},
    {"method", &Settings::method, 0, 0, "dt|odt|wodtem", "command line"},
    {"preset", &Settings::preset, 0, 0, "paper|small", "command line"},
    {"seed", &Settings::seed, 0, 4294967295, "", "command line"},
    {"arithmetic", &Settings::arithmetic, 0, 0, "fused|plain", "the kernel: multiply-add with one rounding or two"},
    {"physics", &Settings::physics, 0, 0, "none|d4rl|2.2", "the task has no bodies"},
    {"mujoco", &Settings::mujoco, 0, 0, "", "the library's version"},
    {"dataset", &Settings::dataset, 0, 0, "", "made on the spot"},
    {"dataset_sha256", &Settings::dataset_sha256, 0, 0, "", "of the file"},
    {"first_weights", &Settings::first_weights, 0, 0, "", "none: drawn from the seed"},
    // The network.
    {"layers", &Settings::layers, 1, 1000, "", "WODTEM Table I: number of layers"},
    {"heads", &Settings::heads, 1, 1000, "", "WODTEM Table I: number of attention heads"},
    {"width", &Settings::width, 8, 65536, "", "WODTEM Table I: embedding dimension"},
    {"context_length", &Settings::context_length, 1, 1000, "", "WODTEM Table I: context length C"},
    {"eval_context", &Settings::eval_context, 1, 1000, "", "ODT's code; never more than context_length"},
    {"position", &Settings::position, 0, 0, "", "WODTEM Table I: position"},
    {"dropout", &Settings::dropout, 0, 0.99, "", "ODT's code"},
    // Optimisation of theta.
    {"optimizer", &Settings::optimizer, 0, 0, "lamb|adamw", "ODT's code: LAMB, which is Adam at weight decay 0"},
    {"learning_rate", &Settings::learning_rate, 0, 1, "", "WODTEM Table I: learning rate"},
    {"weight_decay", &Settings::weight_decay, 0, 1, "", "WODTEM Table I: weight decay"},
    {"clip_norm", &Settings::clip_norm, 0, many, "", "ODT's code; 0: none"},
    {"lamb_always_adapt", &Settings::lamb_always_adapt, 0, 0, "", "ODT's code: no trust ratio at weight decay 0"},
    {"warmup_updates", &Settings::warmup_updates, 0, many, "", "ODT's code: one schedule for both phases"},
    {"batch_size", &Settings::batch_size, 1, 1e6, "", "ODT's code: windows of each update"},
    {"offline_updates", &Settings::offline_updates, 0, many, "", "WODTEM Table I: offline training updates"},
    {"updates_per_iteration", &Settings::updates_per_iteration, 0, many, "",
     "WODTEM Table I: online training updates per iteration"},
    // Optimisation of lambda.
    {"initial_lambda", &Settings::initial_lambda, 1e-9, 1e3, "", "ODT's code"},
    {"lambda_learning_rate", &Settings::lambda_learning_rate, 0, 1, "", "ODT's code: Adam on log lambda"},
    {"eta", &Settings::eta, -many, many, "",
     "chosen: minus the number of action dimensions, as ODT's; paper: a constant"},
    // Data and interaction.
    {"online_steps", &Settings::online_steps, 0, many, "", "WODTEM sec. V-D: 20K; 0: offline only"},
    {"buffer_size", &Settings::buffer_size, 1, 1e6, "", "WODTEM Table I: buffer size, trajectories"},
    {"eval_episodes", &Settings::eval_episodes, 1, 1e6, "", "ODT's code: 10; all would be one here: nothing is random"},
    {"eval_every", &Settings::eval_every, 1, 1e6, "", "ODT's code: online iterations (episodes) from one to the next"},
    {"g_online", &Settings::g_online, -many, many, "", "WODTEM Table I: g_online"},
    {"g_eval", &Settings::g_eval, -many, many, "", "WODTEM Table I: g_eval"},
    {"reward_scale", &Settings::reward_scale, 1e-9, 1e9, "", "chosen: ODT's 0.001 would leave no signal"},
    {"keep_lowest", &Settings::keep_lowest, 0, 0, "", "ODT's code: drops the lowest-return offline trajectory"},
    // Episodic memory.
    {"gamma", &Settings::gamma, 0, 1, "", "WODTEM sec. V-D: discount of d"},
    {"alpha", &Settings::alpha, 0, 1, "", "WODTEM sec. V-D: eq. (7)"},
    {"epsilon", &Settings::epsilon, 0, many, "", "WODTEM sec. V-D: bound on the squared distance"},
    {"tau", &Settings::tau, 1e-9, 1e9, "", "chosen: eq. (6) has none, which is 1"},
    {"K", &Settings::K, 1, 1000, "", "WODTEM sec. V-D: neighbours"},
    {"projected_dim", &Settings::projected_dim, 0, 64, "", "WODTEM sec. V-D: F1; 0: no projection"},
    {"table_size", &Settings::table_size, 1, 1e8, "", "WODTEM sec. V-D: entries"},
    {"keys", &Settings::keys, 0, 0, "raw|normalized", "chosen: WODTEM sec. IV-B.1 indexes by states"},
    {"eviction", &Settings::eviction, 0, 0, "lfu|lru", "WODTEM sec. IV-B.1: least frequently accessed"},
    {"exclude_self", &Settings::exclude_self, 0, 0, "",
     "WODTEM sec. IV-B.2: no exception is made for the state itself"},
    // The grid world.
    {"behaviour", &Settings::behaviour, 0, 0, "right_down|left_down|random|recorded",
     "chosen: the paper's statistics rule out its words"},
    {"edge", &Settings::edge, 0, 0, "clipped|stays|wraps|excluded", "chosen: fits the paper's statistics"},
    {"state_encoding", &Settings::state_encoding, 0, 0, "coordinates|one_hot", "chosen: (row, column)"},
    {"data_trajectories", &Settings::data_trajectories, 1, 1e6, "", "WODTEM sec. IV-A"},
    {"data_seed", &Settings::data_seed, 0, 4294967295, "",
     "chosen: gives mean length 47.50 and return 0.91, sec. IV-A"},
};

// What the D4RL tasks change, later rows over earlier ones. `task`: how its name begins ("" is all of them); `method`:
// "" is all. "unverified" and "one public reproduction" are what they say: ODT's paper gives no such table we could read.
struct TaskRow {
    const char *task, *method, *name, *value, *source;
};
// WODTEM Table II: each row likewise.
inline const TaskRow task_rows[] = {
    {"", "", "layers", "4", "ODT's code"},
    {"", "", "heads", "4", "ODT's code"},
    {"", "", "width", "512", "ODT's code"},
    {"", "", "context_length", "20", "ODT's code"},
    {"", "", "updates_per_iteration", "300", "ODT's code"},
    {"", "", "buffer_size", "1000", "ODT's code"},
    {"", "", "eval_episodes", "10", "ODT's code"},
    {"", "", "reward_scale", "0.001", "ODT's code"},
    {"", "", "learning_rate", "1e-4", "ODT's code"},
    {"", "", "weight_decay", "5e-4", "ODT's code"},
    {"", "", "offline_updates", "5000", "ODT's code"},
    {"", "", "position", "no", "ODT's code"},
    {"", "", "gamma", "0.99", "WODTEM sec. V-C"},
    {"", "", "epsilon", "0.1", "WODTEM sec. V-C"},
    {"", "", "online_steps", "200000", "WODTEM sec. V-C"},
    {"", "", "projected_dim", "4", "WODTEM sec. V-C"},
    {"", "", "table_size", "2e6", "WODTEM sec. V-C"},
    {"", "", "alpha", "0.9", "WODTEM sec. V-C"},
    {"", "", "K", "2", "WODTEM sec. V-C"},
    {"", "", "physics", "d4rl", "chosen: as MuJoCo up to 2.1.0, which made D4RL's data"},
    {"", "", "behaviour", "recorded", "the data set"},
    {"", "", "data_trajectories", "10", "chosen, of random actions: enough to normalise states by"},
    {"", "", "data_seed", "0", "chosen"},
    {"hopper", "", "g_eval", "3600", "ODT's code"},
    {"hopper", "", "g_online", "7200", "ODT's code"},
    {"hopper", "", "eta", "-3", "ODT's code: minus the action dimensions"},
    {"hopper-medium-replay", "", "learning_rate", "2e-3", "one public reproduction of ODT"},
    {"hopper-medium-replay", "", "weight_decay", "1e-4", "one public reproduction of ODT"},
    {"walker2d", "", "learning_rate", "1e-3", "public reproductions of ODT agree"},
    {"walker2d", "", "weight_decay", "1e-3", "public reproductions of ODT agree"},
    {"walker2d", "", "offline_updates", "10000", "public reproductions of ODT agree"},
    {"walker2d", "", "g_eval", "5000", "public reproductions of ODT agree"},
    {"walker2d", "", "g_online", "10000", "public reproductions of ODT agree"},
    {"walker2d", "", "eta", "-6", "ODT's code: minus the action dimensions"},
    {"walker2d", "", "epsilon", "0.2", "WODTEM sec. V-C"},
    {"halfcheetah", "", "g_eval", "6000", "public reproductions of ODT agree"},
    {"halfcheetah", "", "g_online", "12000", "public reproductions of ODT agree"},
    {"halfcheetah", "", "eta", "-6", "ODT's code: minus the action dimensions"},
    {"halfcheetah", "", "epsilon", "0.6", "WODTEM sec. V-C"},
    {"ant-", "", "g_eval", "6000", "unverified"},
    {"ant-", "", "g_online", "12000", "unverified"},
    {"ant", "", "eta", "-8", "ODT's code: minus the action dimensions"},
    {"ant", "", "epsilon", "0.3", "WODTEM sec. V-C"},
    {"antmaze", "", "width", "1024", "one public reproduction of ODT"},
    {"antmaze", "", "learning_rate", "1e-3", "one public reproduction of ODT"},
    {"antmaze", "", "weight_decay", "0", "one public reproduction of ODT"},
    {"antmaze", "", "offline_updates", "7000", "one public reproduction of ODT"},
    {"antmaze", "", "buffer_size", "1500", "one public reproduction of ODT"},
    {"antmaze", "", "position", "yes", "one public reproduction of ODT"},
    {"antmaze", "", "g_eval", "1", "one public reproduction of ODT"},
    {"antmaze", "", "g_online", "2", "one public reproduction of ODT"},
    {"antmaze", "", "reward_scale", "1", "ODT's code"},
    {"maze2d", "", "layers", "4", "WODTEM Table II: number of layers"},
    {"maze2d", "", "heads", "4", "WODTEM Table II: number of attention heads"},
    {"maze2d", "", "width", "512", "WODTEM Table II: embedding dimension"},
    {"maze2d", "", "context_length", "20", "WODTEM Table II: context length"},
    {"maze2d", "", "learning_rate", "1e-3", "WODTEM Table II: learning rate"},
    {"maze2d", "", "weight_decay", "0", "WODTEM Table II: weight decay"},
    {"maze2d", "", "offline_updates", "20000", "WODTEM Table II: offline training updates"},
    {"maze2d", "", "updates_per_iteration", "300", "WODTEM Table II: online training updates per iteration"},
    {"maze2d", "", "buffer_size", "1500", "WODTEM Table II: buffer size"},
    {"maze2d", "", "position", "yes", "WODTEM Table II: position"},
    {"maze2d", "", "eta", "-2", "ODT's code: minus the action dimensions"},
    {"maze2d-umaze", "", "g_online", "340", "WODTEM Table II: g_online"},
    {"maze2d-umaze", "", "g_eval", "170", "WODTEM Table II: g_eval"},
    {"maze2d-medium", "", "g_online", "560", "WODTEM Table II: g_online"},
    {"maze2d-medium", "", "g_eval", "280", "WODTEM Table II: g_eval"},
    {"maze2d-large", "", "g_online", "560", "WODTEM Table II: g_online"},
    {"maze2d-large", "", "g_eval", "280", "WODTEM Table II: g_eval"},
    {"maze2d-large", "", "table_size", "4e6", "WODTEM sec. V-C"},
    {"", "dt", "layers", "3", "DT's code"},
    {"", "dt", "heads", "1", "DT's code"},
    {"", "dt", "width", "128", "DT's code"},
    {"", "dt", "eval_context", "20", "DT's code"},
    {"", "dt", "batch_size", "64", "DT's code"},
    {"", "dt", "optimizer", "adamw", "DT's code"},
    {"", "dt", "learning_rate", "1e-4", "DT's code"},
    {"", "dt", "weight_decay", "1e-4", "DT's code"},
    {"", "dt", "offline_updates", "100000", "DT's code"},
    {"", "dt", "position", "yes", "DT's code"},
    {"maze2d", "dt", "reward_scale", "1", "chosen: as others' DT on maze2d"},
};

// Preset small: everything else as in preset paper. A network and a schedule for two cores and half an hour, one for all
// three methods: then only the objective differs.
inline const TaskRow small_rows[] = {
    {"", "", "layers", "2", "preset small"},
    {"", "", "heads", "2", "preset small"},
    {"", "", "width", "64", "preset small"},
    {"", "", "context_length", "1", "preset small: states tell all; more windows instead of longer ones"},
    {"", "", "batch_size", "256", "preset small: ODT's"},
    {"", "", "position", "no",
     "preset small: maze2d's data end after 230 steps; later rows of the table would not learn"},
    {"", "", "learning_rate", "1e-3", "preset small: a narrow network and few updates"},
    {"", "", "warmup_updates", "1000", "preset small: a tenth of ODT's"},
    {"", "", "offline_updates", "6000", "preset small"},
    {"", "dt", "offline_updates", "12700", "preset small: as many as the others make, where episodes have 300 steps"},
    {"", "", "updates_per_iteration", "100", "preset small"},
    {"", "", "online_steps", "20000", "preset small: a tenth of WODTEM's"},
    {"maze2d", "", "reward_scale", "1", "preset small: at ODT's 0.001 returns-to-go, at most 0.055, are not heeded"},
    {"maze2d", "", "buffer_size", "4000", "preset small: the best 1500 trajectories all leave the goal"},
};

// The number of single-letter changes from one word to the other (Levenshtein), for "did you mean".
int edit_distance(const std::string& a, const std::string& b) {
    std::vector<int> row(b.size() + 1);
    for (size_t j = 0; j <= b.size(); ++j) row[j] = static_cast<int>(j);
    for (size_t i = 1; i <= a.size(); ++i) {
        int diagonal = row[0]++;
        for (size_t j = 1; j <= b.size(); ++j)
            diagonal = std::exchange(row[j], std::min({row[j] + 1, row[j - 1] + 1, diagonal + (a[i - 1] != b[j - 1])}));
    }
    return row[b.size()];
}

std::string nearest_name(const std::string& name, const std::vector<std::string>& names) {
    return *std::min_element(names.begin(), names.end(), [&](const std::string& a, const std::string& b) {
        return edit_distance(name, a) < edit_distance(name, b);
    });
}

std::vector<std::string> split(const std::string& text, char separator) {
    std::vector<std::string> parts(1);
    for (const char c : text)
        if (c == separator)
            parts.emplace_back();
        else
            parts.back() += c;
    return parts;
}

// Shortest text that reads back as the same number.
std::string number_text(double x) {
    char text[32];
    const auto end = std::to_chars(text, text + sizeof text, x).ptr;
    return {text, end};
}

std::string number_text(float x) {
    char text[32];
    const auto end = std::to_chars(text, text + sizeof text, x).ptr;
    return {text, end};
}

std::optional<double> to_number(const std::string& text) {
    double x = 0;
    const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), x);
    if (error != std::errc() || end != text.data() + text.size() || !std::isfinite(x)) return std::nullopt;
    return x;
}

const SettingRow& setting_row(const std::string& name) {
    std::vector<std::string> names;
    for (const SettingRow& row : setting_rows) {
        if (name == row.name) return row;
        names.push_back(row.name);
    }
    fail("usage.setting", "unknown setting \"%s\"; the nearest is \"%s\"", name.c_str(),
         nearest_name(name, names).c_str());
}

std::string setting_text(const Settings& settings, const SettingRow& row) {
    return std::visit(
        [&](auto field) -> std::string {
            const auto& value = settings.*field;
            using Value = std::decay_t<decltype(value)>;
            if constexpr (std::is_same_v<Value, bool>) return value ? "yes" : "no";
            if constexpr (std::is_same_v<Value, int64_t>) return std::to_string(value);
            if constexpr (std::is_same_v<Value, double>) return number_text(value);
            if constexpr (std::is_same_v<Value, std::string>) return value;
        },
        row.field);
}

// Errors: usage.setting with what is allowed.
void set_setting(Settings& settings, const std::string& name, const std::string& text) {
    const SettingRow& row = setting_row(name);
    if (auto field = std::get_if<std::string Settings::*>(&row.field)) {
        const std::vector<std::string> choices = split(row.choices, '|');
        if (*row.choices != 0 && std::find(choices.begin(), choices.end(), text) == choices.end())
            fail("usage.setting", "%s cannot be \"%s\"; it is one of %s; the nearest is \"%s\"", row.name, text.c_str(),
                 row.choices, nearest_name(text, choices).c_str());
        settings.** field = text;
    } else if (auto flag = std::get_if<bool Settings::*>(&row.field)) {
        if (text != "yes" && text != "no")
            fail("usage.setting", "%s cannot be \"%s\"; it is yes or no", row.name, text.c_str());
        settings.** flag = text == "yes";
    } else {
        const std::optional<double> x = to_number(text);
        const auto whole = std::get_if<int64_t Settings::*>(&row.field);
        const bool in_range = x && *x >= row.low && *x <= row.high && (!whole || *x == std::floor(*x));
        if (!in_range) {
            const double nearest = std::clamp(x.value_or(row.low), row.low, row.high);
            fail("usage.setting", "%s cannot be \"%s\"; it is a %snumber from %s to %s; the nearest is %s", row.name,
                 text.c_str(), whole ? "whole " : "", number_text(row.low).c_str(), number_text(row.high).c_str(),
                 number_text(whole ? std::round(nearest) : nearest).c_str());
        }
        if (whole)
            settings.** whole = static_cast<int64_t>(*x);
        else
            settings.*std::get<double Settings::*>(row.field) = *x;
    }
}

// Where a value comes from: the command line, the preset, the method, or the table's source.
void set_from(Settings& settings, const std::string& name, const std::string& text, const std::string& source) {
    set_setting(settings, name, text);
    settings.source[name] = source;
}

// A task's full name; the version may be left off.
std::string full_task_name(const std::string& name) {
    for (const std::string& task : split(task_names, '|'))
        if (task.starts_with(name + "-v") && task.size() == name.size() + 3) return task;
    return name;
}

Settings default_settings(const std::string& task, const std::string& method, const std::string& preset) {
    Settings settings;
    set_setting(settings, "task", full_task_name(task));
    set_setting(settings, "method", method);
    set_setting(settings, "preset", preset);
    const bool gridworld = settings.task == "gridworld";
    const auto apply = [&](std::span<const TaskRow> rows) {
        for (const TaskRow& row : rows)
            if (!gridworld && settings.task.starts_with(row.task) && (*row.method == 0 || method == row.method))
                set_from(settings, row.name, row.value, row.source);
    };
    apply(task_rows);
    if (preset == "small" && gridworld) set_from(settings, "width", "8", "preset small: everything else as in Table I");
    if (preset == "small") apply(small_rows);
    if (method == "dt") {
        set_from(settings, "online_steps", "0", "DT learns offline only");
        for (const char* name : {"layers", "heads", "width", "context_length", "learning_rate", "weight_decay",
                                 "offline_updates", "position"})
            if (gridworld && !settings.source.contains(name))
                settings.source[name] = "chosen for DT: as ODT's in Table I, so that only the objective differs";
    }
    return settings;
}

void check_together(const Settings& settings) {
    const long long width = settings.width, heads = settings.heads;
    if (width % heads != 0)
        fail("usage.setting", "width %lld is not a multiple of heads %lld; the nearest width is %lld", width, heads,
             (width / heads + 1) * heads);
    if (settings.batch_size * settings.context_length > 1000000)
        fail("usage.setting", "batch_size %lld times context_length %lld is more than a million steps in one update",
             static_cast<long long>(settings.batch_size), static_cast<long long>(settings.context_length));
    if (settings.online_steps > 0 && settings.method == "dt")
        fail("usage.setting", "method dt learns offline only: online_steps must be 0, not %lld",
             static_cast<long long>(settings.online_steps));
    const bool gridworld = settings.task == "gridworld";
    if (gridworld != (settings.physics == "none"))
        fail("usage.setting", "%s cannot have physics %s; it is %s", settings.task.c_str(), settings.physics.c_str(),
             gridworld ? "a table of moves: none" : "d4rl or 2.2");
    if (gridworld == (settings.behaviour == "random" || settings.behaviour == "recorded"))
        fail("usage.setting", "%s cannot have behaviour %s; it is %s", settings.task.c_str(),
             settings.behaviour.c_str(), gridworld ? "right_down or left_down" : "recorded or random");
}

// name = value    # source
std::string settings_text(const Settings& settings) {
    std::string text;
    for (const SettingRow& row : setting_rows) {
        const auto source = settings.source.find(row.name);
        std::string line = std::string(row.name) + " = " + setting_text(settings, row);
        line.resize(std::max<size_t>(line.size() + 1, 40), ' ');
        text += line + "# " + (source == settings.source.end() ? row.source : source->second) + "\n";
    }
    return text;
}

// Errors name the file: settings.value, settings.missing.
Settings settings_from_text(const std::string& text, const std::string& path) {
    Settings settings;
    std::set<std::string> found;
    for (const auto& [name, value, source] : parse_settings(text, path)) {
        try {
            set_from(settings, name, value, source);
        } catch (const Error& error) {
            fail("settings.value", "%s: %s; is it damaged, or from another version?", path.c_str(), error.what());
        }
        found.insert(name);
    }
    for (const SettingRow& row : setting_rows)
        if (!found.contains(row.name))
            fail("settings.missing", "%s: setting %s is missing; is it damaged, or from another version?", path.c_str(),
                 row.name);
    return settings;
}

// Errors: run.other_settings. `where`: the file or folder that belongs to `found`.
void require_same_settings(const Settings& found, const Settings& wanted, const std::string& where) {
    for (const SettingRow& row : setting_rows) {
        const std::string was = setting_text(found, row), now = setting_text(wanted, row);
        if (was == now) continue;
        const bool kernel = std::string(row.name) == "arithmetic";
        fail("run.other_settings", "%s belongs to a run with %s = %s, but %s was asked for; %s", where.c_str(),
             row.name, was.c_str(), now.c_str(),
             kernel ? "choose the kernel it was begun with (--kernel)"
                    : "choose another folder with --out, or the same settings");
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// The agent, and everything else that a run must not forget.

struct Normaliser {
    std::vector<float> mean, deviation;  // [state_dim], over all offline states; fixed for the whole run
};

// ODT's code: population standard deviation + 1e-6; the dropped trajectory counts here.
Normaliser fit_normaliser(const std::vector<Trajectory>& trajectories, int state_dim) {
    Normaliser normaliser;
    for (int i = 0; i < state_dim; ++i) {
        double count = 0, sum = 0, squares = 0;
        const auto each = [&](auto&& f) {
            for (const Trajectory& trajectory : trajectories)
                for (size_t at = static_cast<size_t>(i); at < trajectory.states.size();
                     at += static_cast<size_t>(state_dim))
                    f(trajectory.states[at]);
        };
        each([&](float x) { sum += x, ++count; });
        const double mean = sum / count;
        each([&](float x) { squares += (x - mean) * (x - mean); });
        normaliser.mean.push_back(static_cast<float>(mean));
        normaliser.deviation.push_back(static_cast<float>(std::sqrt(squares / count) + 1e-6));
    }
    return normaliser;
}

// What acts: the network and what stands between it and raw states.
struct Agent {
    Settings settings;
    EnvironmentSpec spec;
    Transformer<float> model;
    Normaliser normaliser;
};

TransformerConfig transformer_config(const Settings& settings, const EnvironmentSpec& spec) {
    TransformerConfig config;
    config.state_dim = spec.state_dim;
    config.action_dim = spec.moves > 0 ? spec.moves : spec.action_dim;  // a discrete action enters as a one-hot vector
    config.layers = static_cast<int>(settings.layers);
    config.heads = static_cast<int>(settings.heads);
    config.width = static_cast<int>(settings.width);
    config.max_timesteps = settings.position ? 1000 : 0;  // ODT's code: a table of 1000 rows
    config.dropout = static_cast<float>(settings.dropout);
    config.head = spec.moves > 0            ? Head::categorical
                  : settings.method == "dt" ? Head::deterministic
                                            : Head::squashed_gaussian;
    return config;
}

OptimizerConfig optimizer_config(const Settings& settings) {
    OptimizerConfig config;
    config.rule = settings.optimizer == "lamb" ? OptimizerConfig::Rule::lamb : OptimizerConfig::Rule::adamw;
    config.learning_rate = settings.learning_rate;
    config.weight_decay = settings.weight_decay;
    config.always_adapt = settings.lamb_always_adapt;
    config.clip_norm = settings.clip_norm;
    config.warmup_updates = static_cast<uint64_t>(settings.warmup_updates);
    return config;
}

MemoryConfig memory_config(const Settings& settings, const EnvironmentSpec& spec) {
    MemoryConfig config{};
    config.state_dim = spec.state_dim;
    config.action_dim = spec.action_dim;
    config.projected_dim = static_cast<int>(settings.projected_dim);
    config.capacity = static_cast<size_t>(settings.table_size);
    config.K = static_cast<int>(settings.K);
    config.epsilon = settings.epsilon;
    config.tau = settings.tau;
    config.exclude_self = settings.exclude_self;
    config.eviction = settings.eviction == "lfu" ? Eviction::lfu : Eviction::lru;
    return config;
}

// The Lagrange multiplier of eqs. (1) and (8), kept as its logarithm: so lambda >= 0 by construction. Adam, no warm-up.
struct Temperature {
    std::vector<Parameter<float>> log_lambda;
    Optimizer optimizer;
    explicit Temperature(double initial_lambda)
        : log_lambda{{"log_temperature", {1}, {std::log(static_cast<float>(initial_lambda))}, {0}}} {}
    float lambda() const { return std::exp(log_lambda[0].value[0]); }
};

// How far a run is, and the sums behind the next row of progress.csv.
struct Progress {
    uint64_t updates = 0, interactions = 0, episodes = 0, online = 0, evaluations = 0, next_evaluation = 0;
    uint64_t progress_bytes = 0, episodes_bytes = 0, progress_crc = 0, episodes_crc = 0;  // of the two logs
    double loss = 0, entropy = 0, gradient_norm = 0, summed_updates = 0;
    double pairs = 0, short_pairs = 0, unmatched_pairs = 0;
    double matched = 0, evicted = 0;  // states that the table knew already; entries it had to give up
    double rollout_length = 0, rollout_return = 0, rollouts = 0;
    double dropped = 0;  // episodes that the physics engine spoiled
    double eval_length = NAN, eval_return = NAN;

    template <class Archive>
    void visit(Archive& archive) {
        for (auto [name, field] :
             std::initializer_list<std::pair<const char*, uint64_t&>>{{"progress.updates", updates},
                                                                      {"progress.interactions", interactions},
                                                                      {"progress.episodes", episodes},
                                                                      {"progress.online", online},
                                                                      {"progress.evaluations", evaluations},
                                                                      {"progress.next_evaluation", next_evaluation},
                                                                      {"progress.progress_bytes", progress_bytes},
                                                                      {"progress.episodes_bytes", episodes_bytes},
                                                                      {"progress.progress_crc", progress_crc},
                                                                      {"progress.episodes_crc", episodes_crc}})
            archive(name, field);
        for (auto [name, field] :
             std::initializer_list<std::pair<const char*, double&>>{{"progress.loss", loss},
                                                                    {"progress.entropy", entropy},
                                                                    {"progress.gradient_norm", gradient_norm},
                                                                    {"progress.summed_updates", summed_updates},
                                                                    {"progress.pairs", pairs},
                                                                    {"progress.short_pairs", short_pairs},
                                                                    {"progress.unmatched_pairs", unmatched_pairs},
                                                                    {"progress.matched", matched},
                                                                    {"progress.evicted", evicted},
                                                                    {"progress.rollout_length", rollout_length},
                                                                    {"progress.rollout_return", rollout_return},
                                                                    {"progress.rollouts", rollouts},
                                                                    {"progress.dropped", dropped},
                                                                    {"progress.eval_length", eval_length},
                                                                    {"progress.eval_return", eval_return}})
            archive(name, field);
    }
};

// A batch is worked on in parts of about 2048 tokens, one after the other on one tape: what they compute is still in the
// cache when it is wanted next, and activations take a fraction of the memory. The parts follow from the settings alone,
// because the results depend on them.
size_t parts_of_batch(const Settings& settings) {
    const int64_t windows = std::max<int64_t>(1, 2048 / (3 * settings.context_length));
    return static_cast<size_t>(divide_up(settings.batch_size, windows));
}

struct Run {
    // Training state is exactly this; whatever is not here is not state, and the checkpoint cannot forget it.
    Agent agent;
    Optimizer optimizer;
    Temperature temperature;
    ReplayBuffer replay;    // D_offline in the offline phase, D_online afterwards
    EpisodicMemory memory;  // Q
    Progress progress;

    // What it is worked with.
    Compute& compute;
    size_t parts;  // of a batch
    Tape<float> learning;
    Tape<float> acting;

    Run(Compute& c, const Settings& settings, const EnvironmentSpec& spec)
        : agent{settings,
                spec,
                Transformer<float>(transformer_config(settings, spec), static_cast<uint32_t>(settings.seed)),
                {}},
          temperature(settings.initial_lambda),
          replay{spec.state_dim, spec.action_dim, settings.gamma, static_cast<size_t>(settings.buffer_size), {}, 0, {}},
          memory(memory_config(settings, spec), static_cast<uint32_t>(settings.seed)),
          compute(c),
          parts(parts_of_batch(settings)),
          learning(c),
          acting(c) {
        acting.recording = false;  // and so no dropout
    }

    Random random(uint32_t stream) const { return {static_cast<uint32_t>(agent.settings.seed), stream}; }
    bool remembers() const { return agent.settings.method == "wodtem"; }
    bool constrains_entropy() const { return agent.settings.method != "dt"; }
};

// ---------------------------------------------------------------------------------------------------------------------
// From trajectories to what the network reads.

void append_normalised(std::vector<float>& to, const Normaliser& normaliser, const float* state) {
    for (size_t i = 0; i < normaliser.mean.size(); ++i)
        to.push_back((state[i] - normaliser.mean[i]) / normaliser.deviation[i]);
}

// Actions inside the open interval: atanh(1) is infinite. ODT's code.
float clamp_action(float a) { return std::clamp(a, -1.0f + 1e-6f, 1.0f - 1e-6f); }

void append_action_token(std::vector<float>& to, const EnvironmentSpec& spec, const float* action) {
    if (spec.moves > 0)
        for (int move = 0; move < spec.moves; ++move)
            to.push_back(static_cast<float>(*action) == static_cast<float>(move) ? 1.0f : 0.0f);
    else
        for (int i = 0; i < spec.action_dim; ++i) to.push_back(clamp_action(action[i]));
}

void append_action(std::vector<float>& to, const EnvironmentSpec& spec, const float* action) {
    for (int i = 0; i < spec.action_dim; ++i) to.push_back(spec.moves > 0 ? action[i] : clamp_action(action[i]));
}

// One update's data, or a part of it: n steps of some of the batch_size windows.
// departs from ODT's code: packed, not padded on the left to context_length, so that no mask is needed.
struct Batch {
    SequenceBatch sequences;
    std::vector<float> actions;              // [n, action_dim] a_c
    std::vector<float> remembered;           // [n, action_dim] a-hat(s_c)
    std::vector<double> discounted_returns;  // [n] d_c
    std::vector<const float*> raw_states;    // [n] s_c, in the replay buffer
    std::vector<double> mean;                // [n] 1 / (batch_size |C^t|): over a window's steps, then windows
    std::vector<float> weights;              // [n] w(s_c, a_c)
    std::vector<uint32_t> numbers;           // [n] window * context_length + step: who draws which random number
    Neighbourhoods neighbours;               // [n] K(s_c)
};

// WODTEM sec. IV-B.3, step 1: sub-trajectories (s_{-C,t}, a_{-C,t}, g_{-C,t}, d_{-C,t}) from the replay buffer.
Batch sample_batch(const Run& run, uint32_t first_window, uint32_t end_window) {
    const Settings& settings = run.agent.settings;
    const EnvironmentSpec& spec = run.agent.spec;
    const uint32_t context_length = static_cast<uint32_t>(settings.context_length);
    Batch batch;
    for (uint32_t window = first_window; window < end_window; ++window) {
        const Window at = run.replay.sample(run.random(Stream::batch), run.progress.updates, window,
                                            static_cast<int>(context_length));
        const Trajectory& trajectory = run.replay.trajectories[at.trajectory];
        batch.sequences.lengths.push_back(at.length);
        for (uint32_t c = 0; c < static_cast<uint32_t>(at.length); ++c) {
            const size_t step = static_cast<size_t>(at.start) + c;
            const float* state = &trajectory.states[step * static_cast<size_t>(spec.state_dim)];
            const float* action = &trajectory.actions[step * static_cast<size_t>(spec.action_dim)];
            batch.sequences.returns_to_go.push_back(
                static_cast<float>(trajectory.returns_to_go[step] * settings.reward_scale));
            append_normalised(batch.sequences.states, run.agent.normaliser, state);
            append_action_token(batch.sequences.actions, spec, action);
            batch.sequences.timesteps.push_back(static_cast<int>(step));
            append_action(batch.actions, spec, action);
            batch.discounted_returns.push_back(trajectory.discounted_returns[step]);
            batch.raw_states.push_back(state);
            batch.mean.push_back(1.0 / static_cast<double>(settings.batch_size * at.length));
            batch.numbers.push_back(window * context_length + c);
        }
    }
    batch.remembered = batch.actions;
    batch.weights.assign(batch.mean.size(), 1.0f);
    return batch;
}

// The state by which the memory knows s: raw, or normalised if `keys` says so.
void append_memory_key(std::vector<float>& to, const Agent& agent, const float* state) {
    if (agent.settings.keys == "normalized")
        append_normalised(to, agent.normaliser, state);
    else
        to.insert(to.end(), state, state + agent.spec.state_dim);
}

// Sec. IV-B.1, by eq. (4): the table takes in a trajectory, once, as soon as it is there.
void remember(Run& run, Trajectory trajectory) {
    if (!run.remembers()) return;
    std::vector<float> keys;
    for (size_t at = 0; at < trajectory.states.size(); at += static_cast<size_t>(run.agent.spec.state_dim))
        append_memory_key(keys, run.agent, &trajectory.states[at]);
    trajectory.states = std::move(keys);
    const EpisodicMemory::Changes changes = run.memory.update(trajectory);
    run.progress.matched += static_cast<double>(changes.improved + changes.kept);
    run.progress.evicted += static_cast<double>(changes.evicted);
}

// WODTEM sec. IV-B.3, step 2: look up s_c in Q; weight (s_c, a_c) by eq. (7) and draw a-hat(s_c) by eq. (6), anew in
// each batch. Without a neighbour there is nothing against a_c: w = 1. Only reads the table: parts of a batch look up
// side by side.
void consult_memory(const Run& run, Batch& batch) {
    if (!run.remembers()) return;
    const size_t action_dim = static_cast<size_t>(run.agent.spec.action_dim);
    const Random random = run.random(Stream::remembered_action);
    std::vector<float> keys;
    for (const float* state : batch.raw_states) append_memory_key(keys, run.agent, state);
    batch.neighbours = run.memory.search(keys.data(), batch.raw_states.size());
    for (size_t i = 0; i < batch.weights.size(); ++i) {
        const std::span<const Neighbour> found = batch.neighbours[i];
        const bool optimal = run.memory.is_optimal(found, batch.discounted_returns[i]);
        batch.weights[i] = static_cast<float>(run.memory.weight(optimal, run.agent.settings.alpha));
        if (!optimal) {
            const float* action =
                run.memory.advised_action(found, random.uniform(run.progress.updates, batch.numbers[i]));
            for (size_t j = i * action_dim; j < (i + 1) * action_dim; ++j)
                batch.remembered[j] = run.agent.spec.moves > 0 ? *action++ : clamp_action(*action++);
        }
    }
}

// What the table and the log want to know of a batch that has been looked up.
void count_consultation(Run& run, const Batch& batch) {
    run.progress.pairs += static_cast<double>(batch.mean.size());
    for (size_t i = 0; i < batch.neighbours.size(); ++i) {
        run.memory.count_accesses(batch.neighbours[i]);
        run.progress.unmatched_pairs += batch.neighbours[i].empty();
        run.progress.short_pairs += !run.memory.is_optimal(batch.neighbours[i], batch.discounted_returns[i]);
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// The objective.

template <class T>
struct Objective {
    Tensor<T> L;           // L(theta), or J(theta) where all w = 1
    Tensor<T> H;           // H-bar(theta)
    Tensor<T> lagrangian;  // what theta descends
};

// Equations (2), (3), (8) to (10) for one batch. `entropy_noise` [n, action_dim]: for the Gaussian head only.
template <class T>
Objective<T> objective(Tape<T>& tape, const Policy<T>& policy, const Batch& batch, const float* entropy_noise,
                       std::type_identity_t<T> lambda, bool constrain_entropy) {
    const std::vector<T> mean(batch.mean.begin(), batch.mean.end()), w(batch.weights.begin(), batch.weights.end());
    std::vector<T> observed(mean.size()), advised(mean.size());
    for (size_t i = 0; i < mean.size(); ++i) {
        observed[i] = -mean[i] * w[i];
        advised[i] = -mean[i] * (T(1) - w[i]);
    }
    Objective<T> result;
    // WODTEM eq. (9): L = E[ -1/|C^t| sum_c w log pi(a_c | s^c, g^c) - 1/|C^t| sum_c (1 - w) log pi(a-hat | s^c, g^c) ]
    // WODTEM eq. (2): J is L with w = 1. Both terms read one distribution; the action tokens stay the buffer's.
    // departs from ODT's code: the mean runs over a window's steps, then over windows, as written; not over all steps.
    result.L = combine(tape, T(1), weighted_sum(tape, log_prob(tape, policy, batch.actions.data()), observed.data()),
                       T(1), weighted_sum(tape, log_prob(tape, policy, batch.remembered.data()), advised.data()));
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

// Forward, objective and backward of a batch, or of a part of it. The gradients are added to the model's.
template <class T>
Objective<T> learn(Tape<T>& tape, const Transformer<T>& model, const Batch& batch, const float* entropy_noise,
                   std::type_identity_t<T> lambda, bool constrain_entropy) {
    const Policy<T> policy = forward(tape, model, batch.sequences, Queries::every_state);
    const Objective<T> result = objective(tape, policy, batch, entropy_noise, lambda, constrain_entropy);
    tape.backward(result.lagrangian);
    return result;
}

// The other turn of eq. (1), eq. (8): lambda ascends lambda (eta - H-bar), by log lambda, so lambda >= 0. The gradient
// of log lambda is lambda (eta - H-bar) itself.
void update_lambda(Compute& compute, Temperature& temperature, const Settings& settings, double entropy) {
    OptimizerConfig config;
    config.rule = OptimizerConfig::Rule::adamw;
    config.learning_rate = settings.lambda_learning_rate;
    config.weight_decay = config.clip_norm = 0;
    config.warmup_updates = 0;
    temperature.log_lambda[0].gradient[0] = static_cast<float>(-temperature.lambda() * (settings.eta - entropy));
    update_parameters(compute, temperature.log_lambda, temperature.optimizer, config);
}

// Standard normals for the entropy of the Gaussian head, [n, action_dim]; none for another head.
std::vector<float> entropy_noise(const Run& run, Compute& compute, const Batch& batch) {
    const int dim = run.agent.spec.action_dim, n = static_cast<int>(batch.numbers.size());
    if (run.agent.model.config.head != Head::squashed_gaussian) return {};
    std::vector<float> noise(batch.actions.size());
    const Random random = run.random(Stream::entropy_noise);
    for_rows(compute, n, 100 * dim, [&](int begin, int end, int) {
        for (int i = begin * dim; i < end * dim; ++i)
            noise[static_cast<size_t>(i)] = random.normal(
                run.progress.updates, batch.numbers[static_cast<size_t>(i / dim)], static_cast<uint32_t>(i % dim));
    });
    return noise;
}

// WODTEM sec. IV-B.3, step 3: "alternately optimizing" eq. (8), on one batch: a step of theta, then one of lambda with
// the entropy of the same pass.
void update(Run& run) {
    double loss = 0, entropy = 0;
    const uint32_t parts = static_cast<uint32_t>(run.parts),
                   windows = static_cast<uint32_t>(run.agent.settings.batch_size);
    Tape<float>& tape = run.learning;
    tape.dropout_random = run.random(Stream::dropout);
    tape.dropout_step = run.progress.updates;
    {
        const FrozenWeights frozen(run.compute);
        for (uint32_t part = 0; part < parts; ++part) {
            tape.reset();
            tape.part = part;
            Batch batch = sample_batch(run, windows * part / parts, windows * (part + 1) / parts);
            consult_memory(run, batch);
            const std::vector<float> noise = entropy_noise(run, run.compute, batch);
            const Objective<float> result =
                learn(tape, run.agent.model, batch, noise.data(), run.temperature.lambda(), run.constrains_entropy());
            count_consultation(run, batch);
            loss += result.L.value[0];
            if (run.constrains_entropy()) entropy += result.H.value[0];
        }
    }
    if (!std::isfinite(loss + entropy))
        fail("nn.not_finite", "the loss (%g) or the entropy (%g) is not finite", loss, entropy);
    run.progress.gradient_norm +=
        update_parameters(run.compute, run.agent.model.parameters, run.optimizer, optimizer_config(run.agent.settings));
    if (run.constrains_entropy()) update_lambda(run.compute, run.temperature, run.agent.settings, entropy);
    if (!std::isfinite(run.temperature.lambda())) fail("nn.not_finite", "lambda is not finite");
    run.progress.loss += loss;
    run.progress.entropy += entropy;
    run.progress.summed_updates += 1;
    run.progress.updates += 1;
}

// ---------------------------------------------------------------------------------------------------------------------
// Acting, sec. III-B.

enum class Act { sample, most_likely };  // online interaction; evaluation

// a = tanh(u), as it is stored and stepped.
float squashed_action(float u) { return clamp_action(std::tanh(u)); }

// Of the log-probabilities of all moves: the most likely one (ties: the first); the one whose share of [0, 1) contains
// `uniform`.
int most_likely_move(const float* log_p, int moves) {
    return static_cast<int>(std::max_element(log_p, log_p + moves) - log_p);
}
int sampled_move(const float* log_p, int moves, double uniform) {
    int move = 0;
    while (move + 1 < moves && (uniform -= static_cast<double>(std::exp(log_p[move]))) >= 0) ++move;
    return move;
}

// The action of one row of the policy, as it is stored and stepped. Random: one stream, one number per dimension.
std::vector<float> choose_action(const Agent& agent, const Policy<float>& policy, int row, Act act,
                                 const Random& random, uint64_t episode, uint32_t t) {
    const int columns = policy.output.columns;
    const float* mean = policy.output.value + static_cast<ptrdiff_t>(row) * columns;
    std::vector<float> action;
    if (agent.spec.moves > 0) {
        if (act == Act::most_likely) return {static_cast<float>(most_likely_move(mean, columns))};
        return {static_cast<float>(sampled_move(mean, columns, random.uniform(episode, t)))};
    }
    for (int i = 0; i < columns; ++i) {
        const ptrdiff_t at = static_cast<ptrdiff_t>(row) * columns + i;
        float u = mean[i];
        const bool gaussian = agent.model.config.head == Head::squashed_gaussian;
        if (gaussian && act == Act::sample)
            u += std::exp(policy.log_std.value[at]) * random.normal(episode, t, static_cast<uint32_t>(i));
        action.push_back(gaussian ? squashed_action(u) : clamp_action(u));
    }
    return action;
}

// An episode under way. returns_to_go is what the agent is told: the target, less what it has received.
struct Episode {
    Trajectory trajectory;
    std::vector<float> state;          // [state_dim] the present one
    std::vector<float> returns_to_go;  // [t + 1] scaled
    bool over = false;
    std::string problem;           // why the episode is worth nothing, if it is
    std::exception_ptr exception;  // for whoever waits for its thread
};

// The latest `context` steps of every episode that goes on, the present state last.
SequenceBatch acting_batch(const Agent& agent, const std::vector<Episode>& episodes) {
    const size_t S = static_cast<size_t>(agent.spec.state_dim), A = static_cast<size_t>(agent.spec.action_dim);
    const int context = static_cast<int>(std::min(agent.settings.eval_context, agent.settings.context_length));
    SequenceBatch batch;
    for (const Episode& episode : episodes) {
        if (episode.over) continue;
        const int t = episode.trajectory.length(), first = std::max(0, t + 1 - context);
        batch.lengths.push_back(t + 1 - first);
        for (int c = first; c <= t; ++c) {
            const size_t step = static_cast<size_t>(c);
            append_normalised(batch.states, agent.normaliser,
                              c < t ? &episode.trajectory.states[step * S] : episode.state.data());
            batch.returns_to_go.push_back(episode.returns_to_go[step]);
            batch.timesteps.push_back(c);
            const std::vector<float> none(A);  // the present step has no action yet, and its token is never built
            append_action_token(batch.actions, agent.spec, c < t ? &episode.trajectory.actions[step * A] : none.data());
        }
    }
    return batch;
}

// One step of an episode. What the engine makes of a state beyond its reach is no data: the episode is over, and spoiled.
template <class Environment>
void step_episode(Episode& episode, Environment& environment, const std::vector<float>& action, double reward_scale) {
    Trajectory& trajectory = episode.trajectory;
    trajectory.states.insert(trajectory.states.end(), episode.state.begin(), episode.state.end());
    trajectory.actions.insert(trajectory.actions.end(), action.begin(), action.end());
    try {
        const Step step = environment.step(action.data(), episode.state.data());
        trajectory.rewards.push_back(static_cast<float>(step.reward));
        trajectory.terminated = episode.over = step.terminated;
        // WODTEM sec. III-B, g_{t+1}: g_{t+1} = g_t - r_t
        episode.returns_to_go.push_back(episode.returns_to_go.back() - static_cast<float>(step.reward * reward_scale));
    } catch (const Error& error) {
        if (error.id != "mujoco.unstable") throw;
        trajectory.rewards.push_back(0);
        episode.over = true;
        episode.problem = error.what();
    }
}

// Plays `count` episodes numbered from `first_episode` side by side, through the network as one batch; environments
// step on the threads there are. `environments`: at least as many, in whatever state.
// Sec. III-B: g_1 = target; a_t from the policy: sampled, or the most likely one.
template <class Environment>
std::vector<Episode> rollout(Run& run, std::vector<Environment>& environments, Act act, double target,
                             uint64_t first_episode, int count) {
    const Agent& agent = run.agent;
    const EnvironmentSpec& spec = agent.spec;
    const double reward_scale = agent.settings.reward_scale;
    const FrozenWeights frozen(run.compute);
    std::vector<Episode> episodes(static_cast<size_t>(count));
    for (size_t i = 0; i < episodes.size(); ++i) {
        episodes[i].state.resize(static_cast<size_t>(spec.state_dim));
        episodes[i].returns_to_go = {static_cast<float>(target * reward_scale)};
        environments[i].reset(run.random(Stream::environment), first_episode + i, episodes[i].state.data());
    }
    for (uint32_t t = 0; t < static_cast<uint32_t>(spec.max_episode_steps); ++t) {
        const SequenceBatch batch = acting_batch(agent, episodes);
        if (batch.lengths.empty()) break;
        run.acting.reset();
        const Policy<float> policy = forward(run.acting, agent.model, batch, Queries::last_state);
        std::vector<size_t> going;
        std::vector<std::vector<float>> actions;
        for (size_t i = 0; i < episodes.size(); ++i) {
            if (episodes[i].over) continue;
            actions.push_back(choose_action(agent, policy, static_cast<int>(going.size()), act,
                                            run.random(Stream::exploration), first_episode + i, t));
            going.push_back(i);
        }
        run.compute.threads.run(static_cast<int>(going.size()), [&](int task, int) {
            const size_t row = static_cast<size_t>(task), i = going[row];
            try {
                step_episode(episodes[i], environments[i], actions[row], reward_scale);
            } catch (...) {
                episodes[i].exception = std::current_exception();
            }
        });
        for (const Episode& episode : episodes)
            if (episode.exception) std::rethrow_exception(episode.exception);
    }
    for (Episode& episode : episodes)
        relabel(episode.trajectory, spec.state_dim, spec.action_dim, agent.settings.gamma);
    return episodes;
}

void report_dropped(Run& run, const Episode& episode, const char* kind) {
    run.progress.dropped += 1;
    std::fprintf(stderr, "wodtem: %s episode is dropped: %s\n", kind, episode.problem.c_str());
}

constexpr uint64_t evaluation_episodes = uint64_t{1} << 40;  // their numbers start here, those of online episodes at 0

struct Evaluation {
    double mean_length = NAN, mean_return = NAN;  // of the episodes that the engine has not spoiled
    std::vector<Episode> episodes;
};

// Sec. III-B: the mean (or the most probable action) of the policy, g_1 = g_eval. `number`: of the evaluation.
template <class Environment>
Evaluation evaluate(Run& run, std::vector<Environment>& environments, uint64_t number, int count) {
    Evaluation result;
    const uint64_t first = evaluation_episodes + number * static_cast<uint64_t>(count);
    result.episodes = rollout(run, environments, Act::most_likely, run.agent.settings.g_eval, first, count);
    double length = 0, total = 0, sound = 0;
    for (const Episode& episode : result.episodes) {
        if (!episode.problem.empty()) {
            report_dropped(run, episode, "an evaluation");
            continue;
        }
        length += episode.trajectory.length();
        total += total_return(episode.trajectory);
        sound += 1;
    }
    result.mean_length = length / sound;  // once: whole lengths give exact means
    result.mean_return = total / sound;
    return result;
}

// ---------------------------------------------------------------------------------------------------------------------
// The run folder: settings, progress.csv, episodes.csv, model.safetensors, and checkpoint.safetensors while it runs.

namespace fs = std::filesystem;

constexpr const char* progress_header =
    "phase,updates,interactions,episodes,learning_rate,loss,entropy,lambda,gradient_norm,short,unmatched,memory,"
    "eval_length,eval_return,eval_score,rollout_length,rollout_return,matched,evicted,dropped,physics\n";
constexpr const char* episodes_header = "episode,interactions,length,return,terminated,actions,physics\n";

// Everything in Run that is state, in the order of its members; saving and loading read the same list.
template <class Archive>
void visit_state(Archive& archive, Run& run) {
    run.progress.visit(archive);
    const auto optimizer = [&](const std::string& name, std::vector<Parameter<float>>& parameters, Optimizer& state) {
        archive(name + ".updates", state.updates);
        state.first_moment.resize(parameters.size());
        state.second_moment.resize(parameters.size());
        for (size_t i = 0; i < parameters.size(); ++i) {
            const size_t size = parameters[i].value.size();
            for (auto [part, values] : std::initializer_list<std::pair<const char*, std::vector<float>&>>{
                     {".value.", parameters[i].value},
                     {".first_moment.", state.first_moment[i]},
                     {".second_moment.", state.second_moment[i]}}) {
                values.resize(size);                                // moments that no update has touched yet are zeros
                archive(name + part + parameters[i].name, values);  // in place: the network's tensors point there
            }
        }
    };
    optimizer("model", run.agent.model.parameters, run.optimizer);
    archive("normaliser.mean", run.agent.normaliser.mean);
    archive("normaliser.deviation", run.agent.normaliser.deviation);
    optimizer("temperature", run.temperature.log_lambda, run.temperature.optimizer);
    if (run.progress.online != 0) run.replay.visit(archive);  // before, it is the data set
    run.memory.visit(archive);
}

struct RunFolder {
    std::string path;
    std::string file(const char* name) const { return path + "/" + name; }
};

// Logs first, to the disk: the checkpoint notes how long they are.
void save_checkpoint(Run& run, const RunFolder& folder) {
    AppendFile(folder.file("progress.csv")).sync();
    AppendFile(folder.file("episodes.csv")).sync();
    TensorFile file;
    file.metadata["format"] = "wodtem checkpoint 1";
    file.metadata["settings"] = settings_text(run.agent.settings);
    Saver saver{file};
    visit_state(saver, run);
    write_safetensors(folder.file("checkpoint.safetensors"), file);
}

// Errors name the file: a checkpoint may be damaged, or belong to another program's idea of a run.
void load_state(Run& run, const std::string& path) {
    try {
        const TensorFile file = read_safetensors(path);
        if (file.text("format") != "wodtem checkpoint 1")
            fail("checkpoint.format", "it is no checkpoint of `wodtem train`");
        require_same_settings(settings_from_text(file.text("settings"), path), run.agent.settings, path);
        Loader loader{file};
        visit_state(loader, run);
    } catch (const Error& error) {
        fail(error.id.c_str(), "%s cannot be used: %s; remove it to start this run anew", path.c_str(), error.what());
    }
}

// The state, and the logs cut back to where they were at that moment.
void load_checkpoint(Run& run, const RunFolder& folder) {
    load_state(run, folder.file("checkpoint.safetensors"));
    struct Log {
        std::string path;
        uint64_t bytes, crc;
    };
    const Progress& p = run.progress;
    const Log logs[] = {{folder.file("progress.csv"), p.progress_bytes, p.progress_crc},
                        {folder.file("episodes.csv"), p.episodes_bytes, p.episodes_crc}};
    for (const Log& log : logs) {  // both are as they were, or neither is touched
        const std::string text = fs::exists(log.path) ? read_file(log.path) : "";
        if (text.size() < log.bytes || crc32(std::string_view(text).substr(0, log.bytes)) != log.crc)
            fail("run.log",
                 "%s is not what it was at the checkpoint (%llu bytes); restore it, or remove the folder to start anew",
                 log.path.c_str(), static_cast<unsigned long long>(log.bytes));
    }
    for (const Log& log : logs) truncate_file(log.path, log.bytes);
}

// Adds a line to a log, and to what the checkpoint will know of it.
void append_line(const std::string& path, const std::string& line, uint64_t& bytes, uint64_t& crc) {
    AppendFile(path).append(line);
    bytes += line.size();
    crc = crc32(line, static_cast<uint32_t>(crc));
}

void remove_checkpoint(const RunFolder& folder) {
    for (const char* name : {"checkpoint.safetensors", "checkpoint.safetensors.tmp"}) fs::remove(folder.file(name));
}

// Weights under ODT's names, the temperature, the normaliser and the settings: all that `eval` needs.
void save_model(const Run& run, const std::string& path) {
    TensorFile file;
    file.metadata["format"] = "wodtem model 1";
    file.metadata["settings"] = settings_text(run.agent.settings);
    file.metadata["updates"] = std::to_string(run.progress.updates);
    file.metadata["interactions"] = std::to_string(run.progress.interactions);
    for (const Parameter<float>& parameter : run.agent.model.parameters)
        file.add(parameter.name, parameter.shape, parameter.value);
    const Parameter<float>& log_lambda = run.temperature.log_lambda[0];
    file.add(log_lambda.name, {}, log_lambda.value);
    file.add("state_mean", {run.agent.normaliser.mean.size()}, run.agent.normaliser.mean);
    file.add("state_std", {run.agent.normaliser.deviation.size()}, run.agent.normaliser.deviation);
    write_safetensors(path, file);
}

// "a", "b" and 3 more; for messages.
std::string some_names(const std::vector<std::string>& names) {
    std::string text;
    for (size_t i = 0; i < std::min<size_t>(names.size(), 8); ++i) text += (i > 0 ? ", " : "") + json_string(names[i]);
    return text + (names.size() > 8 ? " and " + std::to_string(names.size() - 8) + " more" : "");
}

// The file has the network's tensors, and no others but those of `besides`, which it may have.
// Errors: model.names names what is missing and what is unknown.
void require_names(const TensorFile& file, const Run& run, const std::set<std::string>& besides) {
    std::set<std::string> known = besides;
    std::vector<std::string> missing, unknown;
    for (const Parameter<float>& parameter : run.agent.model.parameters) {
        known.insert(parameter.name);
        if (!file.has(parameter.name)) missing.push_back(parameter.name);
    }
    for (const StoredTensor& tensor : file.tensors)
        if (!known.contains(tensor.name)) unknown.push_back(tensor.name);
    if (missing.empty() && unknown.empty()) return;
    fail("model.names",
         "%s: does not hold the network of its settings: %s%s%s%s; are layers, position and method right?",
         file.path.c_str(), missing.empty() ? "" : "missing ", some_names(missing).c_str(),
         unknown.empty() ? "" : (missing.empty() ? "unknown " : "; unknown "), some_names(unknown).c_str());
}

// Errors: model.value, and those of TensorFile::read_into.
void load_weights(Run& run, const TensorFile& file) {
    for (Parameter<float>& parameter : run.agent.model.parameters)
        file.read_into(std::span(parameter.value), parameter.name, parameter.shape);
}

void check_model(const Run& run, const std::string& path) {
    const auto require = [&](bool holds, const std::string& name, const char* what) {
        if (!holds)
            fail("model.value", "%s: tensor %s holds a number that is not %s", path.c_str(), name.c_str(), what);
    };
    for (const Parameter<float>& parameter : run.agent.model.parameters)
        for (const float value : parameter.value) require(std::isfinite(value), parameter.name, "finite");
    require(std::isfinite(run.temperature.lambda()), "log_temperature", "finite, nor is its exponential");
    for (const float value : run.agent.normaliser.mean) require(std::isfinite(value), "state_mean", "finite");
    for (const float value : run.agent.normaliser.deviation)
        require(std::isfinite(value) && value > 0, "state_std", "finite and positive");
}

// What save_model() wrote, but for its counts of updates and interactions.
void load_model(Run& run, const TensorFile& file) {
    const uint64_t S = static_cast<uint64_t>(run.agent.spec.state_dim);
    require_names(file, run, {"log_temperature", "state_mean", "state_std"});
    load_weights(run, file);
    file.read_into(std::span(run.temperature.log_lambda[0].value), "log_temperature", {});
    run.agent.normaliser = {file.get<float>("state_mean", {S}), file.get<float>("state_std", {S})};
    check_model(run, file.path);
}

// `given`: a model file, or a run's folder.
std::string model_path(const std::string& given) {
    return fs::is_directory(given) ? given + "/model.safetensors" : given;
}

// Before anything is allocated by the settings of a file. Errors: model.settings.
void require_room(const TensorFile& file, const Settings& settings) {
    const int64_t weights = 12 * settings.layers * settings.width * settings.width;
    if (settings.width % settings.heads != 0 || static_cast<uint64_t>(weights) > file.buffer.size() / sizeof(float))
        fail("model.settings", "%s: does not hold the %lld weights and more that its settings call for",
             file.path.c_str(), static_cast<long long>(weights));
}

TensorFile open_model(const std::string& given) {
    const std::string path = model_path(given);
    TensorFile file = read_safetensors(path);
    const auto format = file.metadata.find("format");
    if (format == file.metadata.end() || format->second != "wodtem model 1")
        fail("model.format", "%s is a safetensors file, but no model that `wodtem train` has written", path.c_str());
    require_room(file, settings_from_text(file.text("settings"), path));
    return file;
}

// The network that a run begins with, its temperature and its normaliser, from a model of the same shape.
void begin_from_model(Run& run, const TensorFile& file) {
    const Settings theirs = settings_from_text(file.text("settings"), file.path);
    for (const char* name : {"layers", "heads", "width", "position", "state_encoding"}) {
        const SettingRow& row = setting_row(name);
        if (setting_text(theirs, row) != setting_text(run.agent.settings, row))
            fail("model.settings", "%s has %s = %s, the run %s; make them equal with --set", file.path.c_str(), name,
                 setting_text(theirs, row).c_str(), setting_text(run.agent.settings, row).c_str());
    }
    load_model(run, file);
}

// ---------------------------------------------------------------------------------------------------------------------
// Weights to and from ODT's own code. Its state_dict holds, besides our tensors, some that it neither trains nor uses;
// it has no place for the temperature (there a plain attribute), the normaliser and the settings: those go into the
// metadata, numbers as decimal text that reads back exactly.

struct UnusedTensor {
    std::string name;
    Shape shape;
};

// ODT's code: GPT-2's vocabulary of one word; max_ep_len 1000; causal masks for n_positions 1024; heads for state and
// return, which no loss reads.
std::vector<UnusedTensor> unused_odt_tensors(const TransformerConfig& config) {
    const uint64_t d = static_cast<uint64_t>(config.width), S = static_cast<uint64_t>(config.state_dim);
    std::vector<UnusedTensor> unused = {{"transformer.wte.weight", {1, d}}, {"embed_timestep.weight", {1000, d}},
                                        {"predict_state.weight", {S, d}},   {"predict_state.bias", {S}},
                                        {"predict_return.weight", {1, d}},  {"predict_return.bias", {1}}};
    for (int layer = 0; layer < config.layers; ++layer) {
        const std::string attention = "transformer.h." + std::to_string(layer) + ".attn.";
        unused.push_back({attention + "bias", {1, 1, 1024, 1024}});
        unused.push_back({attention + "masked_bias", {}});
    }
    return unused;
}

std::string numbers_text(const std::vector<float>& values) {
    std::string text;
    for (const float value : values) text += (text.empty() ? "" : " ") + number_text(value);
    return text;
}

// Everything that a strict load_state_dict of ODT's model asks for, and nothing else.
TensorFile odt_file(const Run& run) {
    TensorFile file;
    file.metadata["format"] = "ODT state_dict";
    file.metadata["settings"] = settings_text(run.agent.settings);
    file.metadata["updates"] = std::to_string(run.progress.updates);
    file.metadata["interactions"] = std::to_string(run.progress.interactions);
    file.metadata["log_temperature"] = numbers_text(run.temperature.log_lambda[0].value);
    file.metadata["state_mean"] = numbers_text(run.agent.normaliser.mean);
    file.metadata["state_std"] = numbers_text(run.agent.normaliser.deviation);
    for (const Parameter<float>& parameter : run.agent.model.parameters)
        file.add(parameter.name, parameter.shape, parameter.value);
    for (const UnusedTensor& unused : unused_odt_tensors(run.agent.model.config)) {
        size_t size = 1;
        for (const uint64_t extent : unused.shape) size *= extent;
        if (unused.name.ends_with(".attn.bias")) {
            std::vector<uint8_t> seen(size);  // [query, key]
            for (size_t i = 0; i < size; ++i) seen[i] = i % 1024 <= i / 1024;
            file.add(unused.name, unused.shape, seen);
        } else {
            file.add(unused.name, unused.shape,
                     std::vector<float>(size, unused.name.ends_with(".masked_bias") ? -1e4f : 0.0f));
        }
    }
    return file;
}

// A tensor, or else the metadata entry of its name: numbers separated by spaces; nothing if there is neither.
// Errors: import.metadata.
std::vector<float> tensor_or_text(const TensorFile& file, const std::string& name, const Shape& shape, size_t size) {
    if (file.has(name)) return file.get<float>(name, shape);
    if (!file.metadata.contains(name)) return {};
    std::vector<float> values;
    for (const std::string& word : split(file.text(name), ' ')) {
        float value = NAN;
        const char* end = word.data() + word.size();
        if (std::from_chars(word.data(), end, value).ptr != end) value = NAN;
        values.push_back(value);
    }
    if (values.size() != size || !std::all_of(values.begin(), values.end(), [](float x) { return std::isfinite(x); }))
        fail("import.metadata", "%s: metadata entry %s is not %zu finite number%s separated by spaces",
             file.path.c_str(), name.c_str(), size, size == 1 ? "" : "s");
    return values;
}

// The reverse, of a file from ODT's code or from odt_file(). Returns whether the file has a normaliser.
bool load_odt(Run& run, const TensorFile& file) {
    std::set<std::string> besides = {"log_temperature", "state_mean", "state_std"};
    for (const UnusedTensor& unused : unused_odt_tensors(run.agent.model.config)) besides.insert(unused.name);
    require_names(file, run, besides);
    load_weights(run, file);
    const std::vector<float> log_temperature = tensor_or_text(file, "log_temperature", {}, 1);
    if (!log_temperature.empty()) run.temperature.log_lambda[0].value = log_temperature;
    const size_t S = static_cast<size_t>(run.agent.spec.state_dim);
    run.agent.normaliser = {tensor_or_text(file, "state_mean", {S}, S), tensor_or_text(file, "state_std", {S}, S)};
    if (run.agent.normaliser.mean.empty() != run.agent.normaliser.deviation.empty())
        fail("import.metadata", "%s: has one of state_mean and state_std; it needs both, or neither",
             file.path.c_str());
    return !run.agent.normaliser.mean.empty();
}

// Updates and interactions, as save_model() notes them; 0 where the file says nothing.
void load_counts(Run& run, const TensorFile& file) {
    for (auto [name, count] : std::initializer_list<std::pair<const char*, uint64_t&>>{
             {"updates", run.progress.updates}, {"interactions", run.progress.interactions}}) {
        const auto found = file.metadata.find(name);
        const std::optional<double> x = to_number(found == file.metadata.end() ? "0" : found->second);
        if (!x || *x < 0 || *x > 1e15 || *x != std::floor(*x))
            fail("import.metadata", "%s: metadata entry %s is \"%s\", not a number of %s", file.path.c_str(), name,
                 found->second.substr(0, 80).c_str(), name);
        count = static_cast<uint64_t>(*x);
    }
}

std::string csv_line(const std::vector<std::string>& fields) {
    std::string line;
    for (const std::string& field : fields) line += (line.empty() ? "" : ",") + field;
    return line + "\n";
}

// ---------------------------------------------------------------------------------------------------------------------
// What differs between the grid world and the MuJoCo tasks: how they are made, their first data, the score of a return,
// and what their figures need.

// The place of a setting's word among an enumeration's names.
template <size_t N>
int choice(const std::array<const char*, N>& names, const std::string& name) {
    return static_cast<int>(std::find(names.begin(), names.end(), name) - names.begin());
}

GridWorld make_grid_world(const Settings& settings) {
    GridWorld world;
    world.edge = static_cast<EdgeRule>(choice(edge_rule_names, settings.edge));
    world.encoding = static_cast<StateEncoding>(choice(state_encoding_names, settings.state_encoding));
    return world;
}

// Gives f the task's environment. Errors: mujoco.absent in a program built without the library.
template <class F>
void with_environment(const Settings& settings, F&& f) {
    if (settings.task == "gridworld") return f(make_grid_world(settings));
#ifdef WODTEM_MUJOCO
    f(MujocoEnvironment(*find_mujoco_task(settings.task),
                        static_cast<Physics>(choice(physics_names, settings.physics))));
#else
    fail("mujoco.absent", "%s needs MuJoCo 2.2, which was not there when this program was built; %s",
         settings.task.c_str(), mujoco_advice);
#endif
}

std::string physics_text(const Settings& settings) {
    return settings.task == "gridworld" ? "grid world" : settings.physics + " on MuJoCo " + settings.mujoco;
}

std::vector<Trajectory> make_data_set(const Settings& settings, const GridWorld& world) {
    std::vector<Trajectory> trajectories =
        collect_data_set(world, static_cast<Behaviour>(choice(behaviour_names, settings.behaviour)),
                         static_cast<uint32_t>(settings.data_seed), static_cast<int>(settings.data_trajectories));
    const EnvironmentSpec spec = world.spec();
    for (Trajectory& trajectory : trajectories) relabel(trajectory, spec.state_dim, spec.action_dim, settings.gamma);
    return trajectories;
}

double score_of(const GridWorld&, double total_return) { return total_return; }
std::string score_text(const GridWorld&, double) { return ""; }  // the return is the score

void save_paths(const std::vector<GridWorld>&, const Evaluation&, const RunFolder&) {}

// The learned policy's distribution over moves in every cell, at the start of an evaluation: [36][8].
std::vector<std::vector<float>> policy_by_cell(Run& run, GridWorld world) {
    SequenceBatch batch;
    for (world.cell = 0; world.cell < grid_cells; ++world.cell) {
        std::vector<float> state(static_cast<size_t>(run.agent.spec.state_dim));
        world.observe(state.data());
        batch.lengths.push_back(1);
        batch.timesteps.push_back(0);
        batch.returns_to_go.push_back(static_cast<float>(run.agent.settings.g_eval * run.agent.settings.reward_scale));
        append_normalised(batch.states, run.agent.normaliser, state.data());
        batch.actions.resize(batch.actions.size() + grid_moves);
    }
    run.acting.reset();
    const Policy<float> policy = forward(run.acting, run.agent.model, batch, Queries::last_state);
    std::vector<std::vector<float>> probabilities(grid_cells);
    for (size_t i = 0; i < policy.output.size(); ++i)
        probabilities[i / grid_moves].push_back(std::exp(policy.output.value[i]));
    return probabilities;
}

// Shares of the moves made in the start cell.
std::vector<double> moves_at_start(const std::vector<Trajectory>& trajectories, GridWorld world, int state_dim) {
    std::vector<float> start(static_cast<size_t>(state_dim));
    world.cell = grid_start;
    world.observe(start.data());
    std::vector<double> shares(grid_moves);
    double visits = 0;
    for (const Trajectory& trajectory : trajectories)
        for (size_t t = 0; t < trajectory.actions.size(); ++t)
            if (std::equal(start.begin(), start.end(),
                           trajectory.states.begin() + static_cast<ptrdiff_t>(t * start.size())))
                shares[static_cast<size_t>(trajectory.actions[t])] += 1, visits += 1;
    for (double& share : shares) share /= std::max(1.0, visits);
    return shares;
}

void save_results(Run& run, const GridWorld& world, const RunFolder& folder) {
    const std::vector<std::vector<float>> policy = policy_by_cell(run, world);
    std::string cells = "row,column", start = "move,learned,offline,online\n";
    for (const GridMove& move : grid_move_table) cells += std::string(",") + move.name;
    cells += "\n";
    for (int cell = 0; cell < grid_cells; ++cell) {
        std::vector<std::string> fields = {std::to_string(cell / grid_size), std::to_string(cell % grid_size)};
        for (const float p : policy[static_cast<size_t>(cell)]) fields.push_back(number_text(p));
        cells += csv_line(fields);
    }
    const std::vector<double> offline =
        moves_at_start(make_data_set(run.agent.settings, world), world, run.agent.spec.state_dim);
    const std::vector<double> online = moves_at_start(run.replay.trajectories, world, run.agent.spec.state_dim);
    for (size_t move = 0; move < grid_moves; ++move)
        start += csv_line({grid_move_table[move].name, number_text(policy[grid_start][move]),
                           number_text(offline[move]), run.progress.online != 0 ? number_text(online[move]) : "nan"});
    write_file_atomic(folder.file("policy.csv"), cells);
    write_file_atomic(folder.file("start_actions.csv"), start);
}

#ifdef WODTEM_MUJOCO

// The data set's file, or uniformly random actions: there a trajectory that the engine spoils is no data, and the next
// one takes its place.
std::vector<Trajectory> make_data_set(const Settings& settings, MujocoEnvironment environment) {
    const EnvironmentSpec spec = environment.spec();
    std::vector<Trajectory> trajectories;
    if (settings.behaviour == "recorded") {
        const Rows rows = read_data_set(settings.dataset_path);
        trajectories = cut_trajectories(rows, *environment.task, settings.dataset_path);
        require_sound(rows, settings.dataset_path);
    }
    for (uint64_t number = 0;
         settings.behaviour == "random" && trajectories.size() < static_cast<size_t>(settings.data_trajectories);
         ++number)
        if (auto trajectory = random_trajectory(environment, static_cast<uint32_t>(settings.data_seed), number))
            trajectories.push_back(std::move(*trajectory));
    for (Trajectory& trajectory : trajectories) relabel(trajectory, spec.state_dim, spec.action_dim, settings.gamma);
    return trajectories;
}

double score_of(const MujocoEnvironment& environment, double total_return) {
    return normalised_score(*environment.task, total_return);
}
std::string score_text(const MujocoEnvironment& environment, double total_return) {
    return ", normalised score " + number_text(static_cast<float>(score_of(environment, total_return)));
}

// The ways of the latest evaluation's episodes through a maze, the last state too; without those that were spoiled.
void save_paths(const std::vector<MujocoEnvironment>& environments, const Evaluation& evaluation,
                const RunFolder& folder) {
    if (!environments[0].task->maze) return;
    std::string text = "episode,step,goal_x,goal_y,x,y\n";
    size_t sound = 0;
    for (size_t i = 0; i < evaluation.episodes.size(); ++i) {
        if (!evaluation.episodes[i].problem.empty()) continue;
        const std::string number = std::to_string(sound++);
        const std::array<double, 2> goal = environments[i].goal;
        const Episode& episode = evaluation.episodes[i];
        const size_t length = episode.trajectory.rewards.size(), state_dim = episode.state.size();
        for (size_t t = 0; t <= length; ++t) {
            const float* state = t < length ? &episode.trajectory.states[t * state_dim] : episode.state.data();
            text += csv_line({number, std::to_string(t), number_text(goal[0]), number_text(goal[1]),
                              number_text(state[0]), number_text(state[1])});
        }
    }
    write_file_atomic(folder.file("paths.csv"), text);
}

void save_results(Run&, const MujocoEnvironment&, const RunFolder&) {}

#endif

// ---------------------------------------------------------------------------------------------------------------------
// What a person sees while it runs: a bar on a terminal, a line for each tenth of the way otherwise. To stderr.

struct Console {
    using Clock = std::chrono::steady_clock;
    const bool terminal = isatty(STDERR_FILENO) != 0;
    Clock::time_point started = Clock::now(), shown = started - std::chrono::hours(1);
    double first_share = -1;  // of the phase, when this process began it
    int tenth = -1;
    std::string label, phase;

    static double seconds_between(Clock::time_point a, Clock::time_point b) {
        return std::chrono::duration<double>(b - a).count();
    }

    // share: of the phase, 0 to 1.
    void show(const Run& run, const std::string& new_phase, double share) {
        show(new_phase, share, [&] { return numbers(run, Clock::now()); });
    }

    template <class Numbers>
    void show(const std::string& new_phase, double share, Numbers&& numbers_now) {
        const Clock::time_point now = Clock::now();
        if (phase != new_phase) phase = new_phase, first_share = share, tenth = -1, started = now;
        const int new_tenth = static_cast<int>(share * 10);
        if (terminal ? seconds_between(shown, now) < 0.1 && share < 1 : new_tenth == tenth) return;
        shown = now;
        tenth = new_tenth;
        std::string text = label + " " + phase + " " + bar(share);
        if (share > first_share && share < 1) {
            const double left = seconds_between(started, now) / (share - first_share) * (1 - share);
            text += " " + clock_text(static_cast<int>(std::min(left, 3599999.0))) + " left,";
        }
        text += numbers_now();
        if (terminal) text.resize(std::min(text.size(), columns() - 1));  // a line that wraps cannot be drawn over
        std::fprintf(stderr, terminal ? "\r%s\033[K%s" : "%s%s\n", text.c_str(), terminal && share >= 1 ? "\n" : "");
    }

    std::string bar(double share) const {
        const size_t width = 12, filled = static_cast<size_t>(share * static_cast<double>(width));
        char percent[16];
        std::snprintf(percent, sizeof percent, "%3.0f%%", 100 * share);
        return terminal ? "[" + std::string(filled, '#') + std::string(width - filled, '.') + "]" + percent : percent;
    }

    // Loss and entropy since the last evaluation, length and return of the last evaluation, updates a second.
    std::string numbers(const Run& run, Clock::time_point now) const {
        const Progress& p = run.progress;
        char text[200];
        int used = std::snprintf(text, sizeof text, " upd %llu, int %llu", static_cast<unsigned long long>(p.updates),
                                 static_cast<unsigned long long>(p.interactions));
        const auto add = [&](const char* format, double x) {
            if (std::isfinite(x))
                used += std::snprintf(text + used, sizeof text - static_cast<size_t>(used), format, x);
        };
        add(", loss %.2f", p.summed_updates > 0 ? p.loss / p.summed_updates : NAN);
        add(", ent %.2f", p.summed_updates > 0 && run.constrains_entropy() ? p.entropy / p.summed_updates : NAN);
        add(", len %.4g", p.eval_length);
        add(", ret %.3g", p.eval_return);
        add(", %.0f/s", static_cast<double>(p.updates - first_update) / std::max(1e-3, seconds_between(began, now)));
        return text;
    }

    static std::string clock_text(int seconds) {
        char text[32];
        std::snprintf(text, sizeof text, seconds >= 3600 ? "%d:%02d:%02d" : "%.0d%d:%02d", seconds / 3600,
                      seconds / 60 % 60, seconds % 60);
        return text;
    }

    static size_t columns() {
        winsize size{};
        return ioctl(STDERR_FILENO, TIOCGWINSZ, &size) == 0 && size.ws_col > 20 ? size.ws_col : 80;
    }

    Clock::time_point began = Clock::now();
    uint64_t first_update = 0;
};

// The one global: a signal handler has nothing else. Set, it makes the run save a checkpoint and end.
volatile std::sig_atomic_t stop_requested = 0;

// What a phase needs besides the state: where to write, and whom to tell.
template <class Environment>
struct Session {
    std::vector<Environment> environments;  // as many as an evaluation plays side by side
    RunFolder folder;
    Console console;
    double checkpoint_every = 30;  // seconds; when it falls changes nothing but what a kill costs
    Console::Clock::time_point saved = Console::Clock::now();
};

template <class Environment>
void checkpoint_if_due(Run& run, Session<Environment>& session) {
    const auto now = Console::Clock::now();
    if (!stop_requested && Console::seconds_between(session.saved, now) < session.checkpoint_every) return;
    save_checkpoint(run, session.folder);
    session.saved = now;
    if (stop_requested) {
        if (session.console.terminal) std::fprintf(stderr, "\n");
        fail("run.stopped", "stopped after update %llu; everything is saved in %s, and the same command continues",
             static_cast<unsigned long long>(run.progress.updates), session.folder.path.c_str());
    }
}

template <class Environment>
void update_and_watch(Run& run, Session<Environment>& session) {
    try {
        update(run);
    } catch (const Error& error) {
        fail(error.id.c_str(), "update %llu of %s: %s; the run stops here, its last checkpoint is kept",
             static_cast<unsigned long long>(run.progress.updates + 1), session.folder.path.c_str(), error.what());
    }
    checkpoint_if_due(run, session);
}

// ---------------------------------------------------------------------------------------------------------------------
// The two phases.

// Evaluates the policy and adds a row to progress.csv: the state of things, and means since the row before.
template <class Environment>
void evaluate_and_record(Run& run, Session<Environment>& session) {
    Progress& p = run.progress;
    const Evaluation evaluation =
        evaluate(run, session.environments, p.evaluations, static_cast<int>(run.agent.settings.eval_episodes));
    save_paths(session.environments, evaluation, session.folder);
    p.eval_length = evaluation.mean_length;
    p.eval_return = evaluation.mean_return;
    const double learning_rate =
        run.agent.settings.learning_rate *
        warmup_factor(std::max<uint64_t>(1, p.updates) - 1, static_cast<uint64_t>(run.agent.settings.warmup_updates));
    const auto mean = [](double sum, double count) {
        return count > 0 ? number_text(static_cast<float>(sum / count)) : std::string("nan");  // seven digits will do
    };
    const std::string line = csv_line({p.online != 0 ? "online" : "offline",
                                       std::to_string(p.updates),
                                       std::to_string(p.interactions),
                                       std::to_string(p.episodes),
                                       number_text(learning_rate),
                                       mean(p.loss, p.summed_updates),
                                       mean(p.entropy, run.constrains_entropy() ? p.summed_updates : 0),
                                       run.constrains_entropy() ? number_text(run.temperature.lambda()) : "nan",
                                       mean(p.gradient_norm, p.summed_updates),
                                       mean(p.short_pairs, run.remembers() ? p.pairs : 0),
                                       mean(p.unmatched_pairs, run.remembers() ? p.pairs : 0),
                                       std::to_string(run.memory.size()),
                                       number_text(p.eval_length),
                                       number_text(p.eval_return),
                                       number_text(score_of(session.environments[0], p.eval_return)),
                                       mean(p.rollout_length, p.rollouts),
                                       mean(p.rollout_return, p.rollouts),
                                       number_text(p.matched),
                                       number_text(p.evicted),
                                       number_text(p.dropped),
                                       physics_text(run.agent.settings)});
    append_line(session.folder.file("progress.csv"), line, p.progress_bytes, p.progress_crc);
    p.evaluations += 1;
    p.next_evaluation = p.episodes + static_cast<uint64_t>(run.agent.settings.eval_every);
    p.loss = p.entropy = p.gradient_norm = p.summed_updates = p.pairs = p.short_pairs = p.unmatched_pairs = 0;
    p.rollout_length = p.rollout_return = p.rollouts = p.matched = p.evicted = p.dropped = 0;
}

// WODTEM sec. IV-B.3, step 4: offline training (fig. 2) on D_offline. The table has taken in every trajectory of it
// before.
template <class Environment>
void offline_phase(Run& run, Session<Environment>& session) {
    const uint64_t updates = static_cast<uint64_t>(run.agent.settings.offline_updates);
    while (run.progress.updates < updates) {
        update_and_watch(run, session);
        session.console.show(run, "offline", static_cast<double>(run.progress.updates) / static_cast<double>(updates));
    }
    evaluate_and_record(run, session);
}

// One episode of interaction. Sec. III-B: its RTGs are computed from its rewards (relabel, in rollout). It enters
// D_online first in, first out, and the table at once, before the updates that follow it.
template <class Environment>
void interact(Run& run, Session<Environment>& session) {
    Progress& p = run.progress;
    std::vector<Episode> episodes =
        rollout(run, session.environments, Act::sample, run.agent.settings.g_online, p.episodes, 1);
    Trajectory& episode = episodes[0].trajectory;
    p.episodes += 1;
    p.interactions += static_cast<uint64_t>(episode.length());
    if (!episodes[0].problem.empty()) return report_dropped(run, episodes[0], "an online");
    p.rollouts += 1;
    p.rollout_length += episode.length();
    p.rollout_return += total_return(episode);
    std::string moves;
    for (size_t t = 0; run.agent.spec.moves > 0 && t < episode.actions.size(); ++t)
        moves += static_cast<char>('0' + static_cast<int>(episode.actions[t]));
    const std::string line = csv_line({std::to_string(p.episodes), std::to_string(p.interactions),
                                       std::to_string(episode.length()), number_text(total_return(episode)),
                                       episode.terminated ? "1" : "0", moves, physics_text(run.agent.settings)});
    append_line(session.folder.file("episodes.csv"), line, p.episodes_bytes, p.episodes_crc);
    remember(run, episode);
    run.replay.add(std::move(episode));
}

// WODTEM sec. IV-B.3, step 5: online fine-tuning (fig. 2) on D_online, first the best trajectories of D_offline.
// Each iteration: one episode, then updates_per_iteration updates; every eval_every iterations an evaluation.
template <class Environment>
void online_phase(Run& run, Session<Environment>& session) {
    const Settings& settings = run.agent.settings;
    Progress& p = run.progress;
    if (p.online == 0) {
        run.replay.capacity = static_cast<size_t>(settings.buffer_size);
        run.replay.start(std::move(run.replay.trajectories));
        p.online = 1;
    }
    const uint64_t budget = static_cast<uint64_t>(settings.online_steps);
    while (true) {
        const uint64_t owed = static_cast<uint64_t>(settings.offline_updates) +
                              p.episodes * static_cast<uint64_t>(settings.updates_per_iteration);
        const double share = std::min(1.0, static_cast<double>(p.interactions) / static_cast<double>(budget));
        while (p.updates < owed) {
            update_and_watch(run, session);
            session.console.show(run, "online", std::min(share, 0.999));
        }
        const bool last = p.interactions >= budget;
        if (p.episodes >= p.next_evaluation || last) evaluate_and_record(run, session);
        if (last) session.console.show(run, "online", 1);
        if (last) return;
        interact(run, session);
        checkpoint_if_due(run, session);
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// train

// D_offline.
void fill_replay(Run& run, std::vector<Trajectory> data_set) {
    data_set = offline_set(std::move(data_set), run.agent.settings.keep_lowest);
    run.replay.capacity = data_set.size();
    run.replay.start(std::move(data_set));
}

// D_offline, its statistics, and the memory's first contents, in the order of the data set. A given model brings its own
// statistics: its network has seen no others.
void begin_run(Run& run, const std::vector<Trajectory>& data_set) {
    if (run.agent.settings.weights_path.empty())
        run.agent.normaliser = fit_normaliser(data_set, run.agent.spec.state_dim);
    else
        begin_from_model(run, open_model(run.agent.settings.weights_path));
    for (const Trajectory& trajectory : offline_set(data_set, run.agent.settings.keep_lowest))
        remember(run, trajectory);
    fill_replay(run, data_set);
}

// A folder may be new, hold this very run, or hold another: then nothing is touched.
void claim_folder(const Settings& settings, const RunFolder& folder) {
    const std::string path = folder.file("settings");
    if (!fs::exists(path)) {
        if (fs::exists(folder.file("progress.csv")) || fs::exists(folder.file("checkpoint.safetensors")))
            fail("run.folder", "%s holds a run without its settings file; choose another folder with --out",
                 folder.path.c_str());
        write_file_atomic(path, settings_text(settings));
        return;
    }
    const bool begun = fs::exists(folder.file("progress.csv")) || fs::exists(folder.file("checkpoint.safetensors")) ||
                       fs::exists(folder.file("finished"));
    if (begun)
        require_same_settings(settings_from_text(read_file(path, 1 << 20), path), settings, folder.path);
    else
        write_file_atomic(path, settings_text(settings));  // of a start that came to nothing
}

// One process at a time: the folder itself is locked, and the kernel lets go of it however the process ends.
struct FolderLock {
    FileDescriptor folder;
    explicit FolderLock(const std::string& path) : folder(::open(path.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC)) {
        if (folder.fd < 0) fail_file("run.folder", "open the run folder", path);
        if (::flock(folder.fd, LOCK_EX | LOCK_NB) != 0 && errno == EWOULDBLOCK)
            fail("run.busy", "another process is training in %s; wait for it, or choose another folder with --out",
                 path.c_str());
    }
};

struct TrainOptions {
    const Kernel& kernel;
    int threads = 1;
    double checkpoint_every = 30;
};

template <class Environment>
void train_in(const Environment& environment, const Settings& settings, const std::string& path,
              const TrainOptions& options) {
    Session<Environment> session{
        {static_cast<size_t>(settings.eval_episodes), environment}, {path}, {}, options.checkpoint_every};
    session.console.label = settings.method + " " + std::to_string(settings.seed);
    std::error_code problem;
    fs::create_directories(path, problem);
    if (problem) fail("run.folder", "cannot make the run folder %s: %s", path.c_str(), problem.message().c_str());
    const FolderLock lock(path);
    claim_folder(settings, session.folder);
    if (fs::exists(session.folder.file("finished"))) {
        remove_checkpoint(session.folder);
        std::printf("%s is finished already\n", path.c_str());
        return;
    }
    Compute compute(options.kernel, options.threads);
    Run run(compute, settings, environment.spec());
    if (fs::exists(session.folder.file("checkpoint.safetensors"))) {
        load_checkpoint(run, session.folder);
        if (run.progress.online == 0) fill_replay(run, make_data_set(settings, environment));
        std::fprintf(stderr, "%s: continuing at update %llu\n", path.c_str(),
                     static_cast<unsigned long long>(run.progress.updates));
    } else {
        begin_run(run, make_data_set(settings, environment));
        Progress& p = run.progress;
        if (fs::exists(session.folder.file("progress.csv")))
            std::fprintf(stderr, "%s: no checkpoint, starting anew\n", path.c_str());
        for (const char* log : {"progress.csv", "episodes.csv"}) write_file_atomic(session.folder.file(log), "");
        append_line(session.folder.file("progress.csv"), progress_header, p.progress_bytes, p.progress_crc);
        append_line(session.folder.file("episodes.csv"), episodes_header, p.episodes_bytes, p.episodes_crc);
    }
    session.console.first_update = run.progress.updates;
    if (run.progress.online == 0) offline_phase(run, session);
    if (settings.online_steps > 0) online_phase(run, session);
    for (const char* log : {"progress.csv", "episodes.csv"}) AppendFile(session.folder.file(log)).sync();
    save_model(run, session.folder.file("model.safetensors"));
    save_results(run, environment, session.folder);
    write_file_atomic(session.folder.file("finished"), "");
    remove_checkpoint(session.folder);
    std::printf("%s: %llu updates, %llu interactions, evaluation length %s, return %s%s\n", path.c_str(),
                static_cast<unsigned long long>(run.progress.updates),
                static_cast<unsigned long long>(run.progress.interactions),
                number_text(run.progress.eval_length).c_str(), number_text(run.progress.eval_return).c_str(),
                score_text(environment, run.progress.eval_return).c_str());
}

void train(const Settings& settings, const std::string& path, const TrainOptions& options) {
    with_environment(settings, [&](const auto& environment) { train_in(environment, settings, path, options); });
}

// ---------------------------------------------------------------------------------------------------------------------
// The command line. `wodtem COMMAND ...`; results go to stdout, progress and errors to stderr.

struct Option {
    const char* name;
    const char* value;  // what follows it, or null for a switch
    const char* fallback;
    const char* meaning;
};

struct Arguments {
    std::vector<std::string> words;  // that are not options
    std::map<std::string, std::string> options;
    std::vector<std::string> assignments;  // --set name=value, any number
    const std::string& operator[](const char* name) const { return options.at(name); }
};

struct Command {
    const char* name;
    const char* words;  // how the arguments look in the help
    size_t least_words, most_words;
    const char* meaning;
    std::vector<Option> options;
    void (*run)(const Arguments&);
};

const Option method_option = {"--method", "NAME", "wodtem", "dt, odt or wodtem"};
const Option preset_option = {"--preset", "NAME", "small", "paper: Tables I and II as printed; small: less of it"};
const Option seed_option = {"--seed", "N", "", "seed of everything but the data set; default 0"};
const Option seeds_option = {"--seeds", "A-B", "", "several seeds, one after the other"};
const Option physics_option = {"--physics", "NAME", "",
                               "bodies: d4rl (the default), as in MuJoCo up to 2.1.0; 2.2, as that computes them"};
const Option set_option = {"--set", "NAME=VALUE", "",
                           "any setting (see `wodtem info` of a run's model); may be repeated"};
const Option dataset_option = {"--dataset", "FILE", "",
                               "HDF5 in D4RL's or Minari's layout (default: by the task's name); random: none"};
const Option kernel_option = {"--kernel", "NAME", "auto",
                              "matrix kernel: avx512, avx2, portable, or the best there is"};
const Option threads_option = {"--threads", "N", "0", "worker threads; 0: one per core; results do not depend on it"};

// Errors: usage.number.
int64_t whole_number(const std::string& text, const char* name, int64_t low, int64_t high) {
    const std::optional<double> x = to_number(text);
    if (!x || *x != std::floor(*x) || *x < static_cast<double>(low) || *x > static_cast<double>(high)) {
        const double nearest =
            std::clamp(x.value_or(static_cast<double>(low)), static_cast<double>(low), static_cast<double>(high));
        fail("usage.number", "%s cannot be \"%s\"; it is a whole number from %lld to %lld; the nearest is %.0f", name,
             text.c_str(), static_cast<long long>(low), static_cast<long long>(high), std::round(nearest));
    }
    return static_cast<int64_t>(*x);
}

// "3", "0-4" or "1,3,8".
std::vector<int64_t> seed_list(const std::string& text) {
    std::vector<int64_t> seeds;
    for (const std::string& part : split(text, ',')) {  // each seed once
        const size_t dash = part.find('-', 1);
        const int64_t first = whole_number(part.substr(0, dash), "a seed", 0, 4294967295);
        const int64_t last =
            dash == std::string::npos ? first : whole_number(part.substr(dash + 1), "a seed", 0, 4294967295);
        if (last < first || last - first > 9999)
            fail("usage.number", "the seeds \"%s\" are not a range such as 0-4", part.c_str());
        for (int64_t seed = first; seed <= last; ++seed) {
            if (std::find(seeds.begin(), seeds.end(), seed) != seeds.end())
                fail("usage.number", "seed %lld is given twice in \"%s\"", static_cast<long long>(seed), text.c_str());
            seeds.push_back(seed);
        }
    }
    return seeds;
}

int thread_count(const Arguments& arguments) {
    const int64_t asked = whole_number(arguments["--threads"], "--threads", 0, 256);
    return asked > 0 ? static_cast<int>(asked) : static_cast<int>(std::max(1u, std::thread::hardware_concurrency()));
}

// The kernel of that name ("auto": the best one). `arithmetic`: for "auto", the best one of this arithmetic.
// Errors: usage.kernel, with the names of what this machine has.
const Kernel& kernel_named(const std::string& name, const std::string& arithmetic = "") {
    std::string available;
    for (const Kernel* kernel : kernels) {
        if (!kernel->supported()) continue;
        if (name == kernel->name) return *kernel;
        if (name == "auto" && (arithmetic.empty() || arithmetic == kernel->arithmetic)) return *kernel;
        available += std::string(available.empty() ? "" : ", ") + kernel->name;
    }
    fail("usage.kernel", "this machine has no kernel \"%s\"%s; it has: %s (or auto)", name.c_str(),
         arithmetic.empty() ? "" : (" of arithmetic " + arithmetic).c_str(), available.c_str());
}

// `given`: a file; "random": none, ten episodes of random actions and the online phase alone; "": the file of the task's
// id, where there is one by that name. Errors: dataset.missing.
void choose_data_set(Settings& settings, const std::string& given) {
    const PublishedDataSet* published = find_published(settings.task);
    if (given == "random" || (given.empty() && !published)) {
        set_from(settings, "behaviour", "random", "chosen: there is no data set");
        if (settings.method != "dt")
            set_from(settings, "offline_updates", "0", "there is no data set: the online phase alone");
        return;
    }
    settings.dataset_path = given.empty() ? find_data_set(*published) : given;
    settings.dataset_sha256 = sha256_of_file(settings.dataset_path);
    settings.dataset = fs::path(settings.dataset_path).filename();
    const bool original = published && settings.dataset_sha256 == published->sha256;
    settings.source["dataset"] = original ? "D4RL's published file" : "not known as a published file";
}

Settings asked_settings(const Arguments& arguments, const std::string& task, int64_t seed) {
    Settings settings = default_settings(task, arguments["--method"], arguments["--preset"]);
    settings.seed = seed;
    if (settings.task != "gridworld") {
        settings.mujoco = mujoco_version();
        choose_data_set(settings, arguments["--dataset"]);
    }
    if (!arguments["--physics"].empty()) set_from(settings, "physics", arguments["--physics"], "command line");
    std::set<std::string> seen;
    for (const std::string& assignment : arguments.assignments) {
        const size_t equals = assignment.find('=');
        if (equals == std::string::npos)
            fail("usage.setting", "--set needs NAME=VALUE, not \"%s\"", assignment.c_str());
        const std::string name = assignment.substr(0, equals);
        const std::string row = setting_row(name).name;
        for (const char* fixed :
             {"task", "method", "preset", "seed", "arithmetic", "mujoco", "dataset", "dataset_sha256", "first_weights"})
            if (row == fixed) fail("usage.setting", "%s is not given by --set; see wodtem train --help", fixed);
        if (!seen.insert(name).second) fail("usage.setting", "setting %s is given twice", name.c_str());
        set_from(settings, name, assignment.substr(equals + 1), "command line");
    }
    check_together(settings);
    settings.arithmetic = kernel_named(arguments["--kernel"]).arithmetic;
    return settings;
}

std::string default_folder(const Settings& settings) {
    return "runs/" + settings.task + "-" + settings.preset + "-" + settings.method + "-" +
           std::to_string(settings.seed);
}

void stop_on_signals() {
    for (const int signal : {SIGINT, SIGTERM}) {
        std::signal(signal, [](int number) {
            stop_requested = 1;
            std::signal(number, SIG_DFL);  // a second one ends the process at once
        });
    }
}

void command_train(const Arguments& arguments) {
    stop_on_signals();
    const int threads = thread_count(arguments);
    const int64_t checkpoint_every = whole_number(arguments["--checkpoint-every"], "--checkpoint-every", 0, 86400);
    const bool several = !arguments["--seeds"].empty();
    if (several && !arguments["--seed"].empty()) fail("usage.option", "--seed and --seeds were both given; choose one");
    for (const int64_t seed : seed_list(several                       ? arguments["--seeds"]
                                        : arguments["--seed"].empty() ? "0"
                                                                      : arguments["--seed"])) {
        Settings settings = asked_settings(arguments, arguments.words[0], seed);
        if (!arguments["--weights"].empty()) {
            settings.weights_path = model_path(arguments["--weights"]);
            set_from(settings, "first_weights", sha256_of_file(settings.weights_path), "SHA-256 of the model file");
        }
        std::string folder = arguments["--out"].empty() ? default_folder(settings) : arguments["--out"];
        if (several && !arguments["--out"].empty()) folder += "/seed-" + std::to_string(seed);
        std::string line;
        for (const SettingRow& row : setting_rows)
            line += std::string(" ") + row.name + "=" + setting_text(settings, row);
        std::fprintf(stderr, "%s:%s\n", folder.c_str(), line.c_str());
        train(settings, folder, {kernel_named(arguments["--kernel"]), threads, static_cast<double>(checkpoint_every)});
    }
}

template <class Environment>
void evaluate_model(const Environment& environment, const Settings& settings, const TensorFile& file,
                    const Arguments& arguments) {
    const int count = static_cast<int>(whole_number(arguments["--episodes"], "--episodes", 1, 10000));
    Compute compute(kernel_named(arguments["--kernel"]), thread_count(arguments));
    Run run(compute, settings, environment.spec());
    load_model(run, file);
    std::vector<Environment> environments(static_cast<size_t>(count), environment);
    const Evaluation evaluation = evaluate(run, environments, 0, count);
    std::printf("%s, %s, seed %lld: mean length %s, mean return %s%s over %d episode%s (%s)\n", settings.task.c_str(),
                settings.method.c_str(), static_cast<long long>(settings.seed),
                number_text(evaluation.mean_length).c_str(), number_text(evaluation.mean_return).c_str(),
                score_text(environment, evaluation.mean_return).c_str(), count, count == 1 ? "" : "s",
                physics_text(settings).c_str());
    if (run.agent.spec.moves == 0) return;
    std::printf("first episode:");
    for (const float move : evaluation.episodes[0].trajectory.actions)
        std::printf(" %s", grid_move_table[static_cast<size_t>(move)].name);
    std::printf("\n");
}

void command_eval(const Arguments& arguments) {
    const TensorFile file = open_model(arguments.words[0]);
    const Settings settings = settings_from_text(file.text("settings"), file.path);
    with_environment(settings,
                     [&](const auto& environment) { evaluate_model(environment, settings, file, arguments); });
}

void command_export(const Arguments& arguments) {
    if (arguments["--odt"].empty()) fail("usage.option", "export knows one layout; ask for it with --odt");
    const TensorFile model = open_model(arguments.words[0]);
    const Settings settings = settings_from_text(model.text("settings"), model.path);
    with_environment(settings, [&](const auto& environment) {
        Compute compute(best_kernel(), 1);
        Run run(compute, settings, environment.spec());
        load_model(run, model);
        load_counts(run, model);
        const TensorFile file = odt_file(run);
        write_safetensors(arguments.words[1], file);
        std::printf(
            "%s: %zu tensors for a strict load_state_dict of ODT's model%s\n", arguments.words[1].c_str(),
            file.tensors.size(),
            run.agent.spec.moves > 0 ? ", were there not predict_action.logits: ODT has no discrete actions" : "");
    });
}

void command_import(const Arguments& arguments) {
    const TensorFile file = read_safetensors(arguments.words[0]);
    const bool own = arguments["--task"].empty();
    if (own && !file.metadata.contains("settings"))
        fail("usage.option", "%s does not tell its settings; give --task, and --method, --preset, --set as in train",
             file.path.c_str());
    const Settings settings =
        own ? settings_from_text(file.text("settings"), file.path) : asked_settings(arguments, arguments["--task"], 0);
    require_room(file, settings);
    with_environment(settings, [&](const auto& environment) {
        Compute compute(best_kernel(), 1);
        Run run(compute, settings, environment.spec());
        if (!load_odt(run, file)) {
            if (settings.behaviour == "random")
                fail("import.normaliser",
                     "%s has no state_mean and state_std, and there is no data set to take them from; see --dataset",
                     file.path.c_str());
            run.agent.normaliser = fit_normaliser(make_data_set(settings, environment), run.agent.spec.state_dim);
        }
        load_counts(run, file);
        check_model(run, file.path);
        save_model(run, arguments.words[1]);
        std::printf("%s: %s, %s, for wodtem eval and wodtem train --weights\n", arguments.words[1].c_str(),
                    settings.task.c_str(), settings.method.c_str());
    });
}

#ifdef WODTEM_MUJOCO
void make_folder(const fs::path& folder) {
    std::error_code problem;
    fs::create_directories(folder, problem);
    if (problem) fail("collect.folder", "cannot make the folder %s: %s", folder.c_str(), problem.message().c_str());
}

// A stand-in for the data set `id`, or the policy that walks through antmaze, at `path`.
void collect(const std::string& id, const std::string& path, size_t steps, const Origin& origin,
             const std::string& policy_path, int threads) {
    Console console;
    console.label = id;
    const auto show = [&](size_t done) {
        const double share = static_cast<double>(done) / static_cast<double>(steps);
        console.show("collecting", std::min(share, 1.0),
                     [&] { return " row " + std::to_string(std::min(done, steps)); });
    };
    const MujocoTask* task = find_mujoco_task(id);
    const auto policy = [&](const std::string& name) {
        return policy_path.empty() ? embedded_policy(name) : sac::load_policy(policy_path);
    };
    const bool walker = id == walker_name, trains = walker || id.find("-medium-replay") != std::string::npos;
    if (!trains && task->rules == Rules::maze2d) return collect_maze2d(path, *task, steps, origin, show);
    if (!trains && task->rules == Rules::antmaze)
        return collect_antmaze(path, *task, steps, origin, policy(walker_name), show);
    if (!trains) return collect_medium(path, *task, steps, origin, policy(std::string(task->name) + "-medium"), show);

    const std::string folder = path + ".training";
    make_folder(folder);
    const FolderLock lock(folder);
    stop_on_signals();
    const Watch watch{
        [&](double share, const std::string& numbers) { console.show("training", share, [&] { return numbers; }); },
        [] { return stop_requested != 0; }};
    const std::string checkpoint = folder + "/checkpoint.safetensors";
    Training training = walker ? walker_training(origin.seed) : gym_training(*task, origin.seed, steps);
    training.threads = threads;
    if (walker)
        train_walker(path, training, checkpoint, watch);
    else
        collect_medium_replay(path, *task, steps, origin, training, checkpoint, watch);
    fs::remove_all(folder);
}
#endif

void command_collect(const Arguments& arguments) {
    const std::string id = full_task_name(arguments.words[0]);
    const PublishedDataSet* set = find_published(id);
    const bool walker = id == walker_name;
    if (!set && !walker) {
        std::vector<std::string> names = {walker_name};
        for (const PublishedDataSet& one : published_data_sets) names.push_back(one.id);
        fail("usage.task", "collect makes D4RL's data sets, and \"%s\" is none; the nearest is %s", id.c_str(),
             nearest_name(id, names).c_str());
    }
    [[maybe_unused]] const int64_t steps = arguments["--steps"].empty()
                                               ? static_cast<int64_t>(walker ? 0 : set->steps)
                                               : whole_number(arguments["--steps"], "--steps", 1, 100000000);
    [[maybe_unused]] const int64_t seed = whole_number(arguments["--seed"], "--seed", 0, 2147483647);
    [[maybe_unused]] const int threads = thread_count(arguments);
    const std::string path = !arguments["--out"].empty()
                                 ? arguments["--out"]
                                 : std::string(own_folder) + "/" + (walker ? id + ".safetensors" : file_name(*set));
#ifdef WODTEM_MUJOCO
    const fs::path folder = fs::path(path).parent_path();
    if (!folder.empty()) make_folder(folder);
    const Origin origin{
        "wodtem collect " + id + " --steps " + std::to_string(steps) + " --seed " + std::to_string(seed),
        static_cast<uint32_t>(seed)};
    collect(id, path, static_cast<size_t>(steps), origin, arguments["--policy"], threads);
    if (walker)
        std::printf("%s: the policy; wodtem collect antmaze-umaze --policy %s\n", path.c_str(), path.c_str());
    else
        std::printf("%s: %lld steps; see: wodtem info %s\n", path.c_str(), static_cast<long long>(steps), path.c_str());
#else
    fail("mujoco.absent", "%s needs MuJoCo 2.2, which was not there when this program was built; %s", path.c_str(),
         mujoco_advice);
#endif
}

// ----- trace -----

// What a line of a trace's input asks for.
struct TraceLine {
    size_t number;
    std::string text;

    [[noreturn]] void refuse(const std::string& expected) const {
        fail("trace.line", "line %zu of the input is \"%s\"; expected %s", number,
             text.size() > 60 ? (text.substr(0, 60) + "...").c_str() : text.c_str(), expected.c_str());
    }

    // The numbers after `keyword`, as many as `count`.
    std::vector<double> numbers(const std::string& keyword, int count, const std::string& expected) const {
        if (!text.starts_with(keyword)) refuse(expected);
        std::vector<double> values;
        for (const std::string& part : split(text.substr(keyword.size()), ','))
            values.push_back(to_number(part).value_or(NAN));
        if (values.size() != static_cast<size_t>(count) ||
            std::any_of(values.begin(), values.end(), [](double x) { return std::isnan(x); }))
            refuse(expected);
        return values;
    }
};

void print_numbers(std::string line, const std::vector<double>& values) {
    for (const double value : values) {
        char text[40];
        std::snprintf(text, sizeof text, "%.17g", value);
        line += (line.empty() ? "" : ",") + std::string(text);
    }
    std::printf("%s\n", line.c_str());
}

#ifdef WODTEM_MUJOCO
// Steps the environment as the lines of `input` say: `init qpos,...` and `init qvel,...` start a segment, `goal,X,Y`
// moves a maze's goal from there on, any other line is an action. Neither done nor a time limit ends anything.
void trace(MujocoEnvironment environment, std::istream& input) {
    const mjModel& model = *environment.model;
    const std::string finite = " finite numbers, separated by commas";
    const std::string an_init = "init qpos, and " + std::to_string(model.nq) + finite,
                      a_velocity = "init qvel, and " + std::to_string(model.nv) + finite,
                      a_goal = "goal, and 2" + finite,
                      an_action =
                          "an action, " + std::to_string(environment.task->action_dim) + finite + ", or " + an_init;
    std::vector<double> qpos;
    bool started = false;
    TraceLine line{0, ""};
    while (++line.number, std::getline(input, line.text)) {
        if (line.text.starts_with("goal")) {
            if (!environment.task->maze) line.refuse("no goal: " + std::string(environment.task->name) + " is no maze");
            const std::vector<double> goal = line.numbers("goal,", 2, a_goal);
            environment.goal = {goal[0], goal[1]};
        } else if (!qpos.empty()) {
            environment.start(qpos, line.numbers("init qvel,", model.nv, a_velocity));
            print_numbers("init obs", environment.observation);
            qpos.clear();
            started = true;
        } else if (line.text.starts_with("init")) {
            qpos = line.numbers("init qpos,", model.nq, an_init);
        } else {
            if (!started) line.refuse(an_init);
            const std::vector<double> action = line.numbers("", environment.task->action_dim, an_action);
            const Step step = environment.advance(action);
            std::vector<double> row = environment.observation;
            row.push_back(step.reward);
            row.push_back(step.terminated ? 1 : 0);
            print_numbers("", row);
        }
    }
    if (!qpos.empty()) line.refuse(a_velocity);
}
#endif

void command_trace(const Arguments& arguments) {
    Settings settings = default_settings(arguments.words[0], "wodtem", "paper");
    if (!arguments["--physics"].empty()) set_setting(settings, "physics", arguments["--physics"]);
    settings.mujoco = mujoco_version();
    check_together(settings);
    if (settings.task == "gridworld") fail("usage.task", "trace steps the MuJoCo tasks; gridworld is a table of moves");
    std::setvbuf(stdout, nullptr, _IOLBF, 0);  // another program may be waiting for each answer
    with_environment(settings, [&](const auto& environment) {
        std::fprintf(stderr, "%s, %s\n", settings.task.c_str(), physics_text(settings).c_str());
        if constexpr (requires { environment.model; }) trace(environment, std::cin);
    });
}

// -----

void command_report(const Arguments& arguments) {
    const std::string out = arguments["--out"];
    std::printf("%s", report(arguments.words, out).c_str());
    std::printf("report: %s/report.html\n", out.c_str());
}

// How long an update takes here, times how many there will be: offline_updates, and updates_per_iteration for each
// episode. The episodes are not known beforehand: on the grid world the means of preset small over seeds 0 to 4 stand in
// (README.md), elsewhere episodes that use up the time limit; shorter ones are more.
double estimated_seconds(Settings settings) {
    if (settings.task != "gridworld") settings.behaviour = "random";
    double seconds = 0;
    with_environment(settings, [&](const auto& environment) {
        Compute compute(best_kernel(), static_cast<int>(std::max(1u, std::thread::hardware_concurrency())));
        Run run(compute, settings, environment.spec());
        begin_run(run, make_data_set(settings, environment));
        update(run);
        const auto begin = Console::Clock::now();
        for (int i = 0; i < 3; ++i) update(run);
        const double update_seconds = Console::seconds_between(begin, Console::Clock::now()) / 3;
        double episodes =
            static_cast<double>(settings.online_steps) / static_cast<double>(environment.spec().max_episode_steps);
        if (settings.task == "gridworld")
            episodes = settings.method == "dt" ? 0 : settings.method == "odt" ? 498 : 2041;
        seconds = update_seconds * (static_cast<double>(settings.offline_updates) +
                                    episodes * static_cast<double>(settings.updates_per_iteration));
    });
    return seconds;
}

void command_sweep(const Arguments& arguments) {
    const std::vector<int64_t> seeds = seed_list(arguments["--seeds"]);
    const bool estimate = !arguments["--estimate"].empty();
    std::vector<Settings> all;  // checked before anything is printed: a job runner may be reading
    for (const std::string& method : split(arguments["--methods"], ','))
        all.push_back(default_settings(arguments.words.empty() ? "gridworld" : arguments.words[0], method,
                                       arguments["--preset"]));
    double seconds = 0;
    for (const Settings& settings : all) {
        check_together(settings);
        if (estimate) seconds += estimated_seconds(settings) * static_cast<double>(seeds.size());
    }
    for (const Settings& settings : all)
        for (const int64_t seed : seeds)
            std::printf("%s./wodtem train %s --method %s --preset %s --seed %lld\n", estimate ? "# " : "",
                        settings.task.c_str(), settings.method.c_str(), settings.preset.c_str(),
                        static_cast<long long>(seed));
    if (estimate)
        std::printf("# about %.1f hours on this machine, one after the other; what is interrupted continues\n",
                    seconds / 3600);
}

template <class T>
std::string value_range(const TensorFile& file, const StoredTensor& tensor) {
    const std::vector<T> values = file.get<T>(tensor.name, tensor.shape);
    if (std::none_of(values.begin(), values.end(), [](T value) { return std::isfinite(static_cast<double>(value)); }))
        return "nothing finite";
    double low = INFINITY, high = -INFINITY, sum = 0;
    size_t bad = 0;
    for (const T value : values) {
        const double x = static_cast<double>(value);
        if (!std::isfinite(x)) {
            ++bad;
            continue;
        }
        low = std::min(low, x), high = std::max(high, x), sum += x;
    }
    char text[160];
    std::snprintf(text, sizeof text, "%.6g to %.6g, mean %.6g%s", low, high,
                  sum / static_cast<double>(values.size() - bad), bad > 0 ? ", NOT FINITE: " : "");
    return text + (bad > 0 ? std::to_string(bad) : std::string());
}

// A data set in HDF5: what the file holds, then what it means. `id`: of the task, "" to go by the file's name and sums.
void describe_data_set(const std::string& path, std::string id) {
    const Hdf5File file = open_hdf5(path);
    const std::string sha256 = sha256_of_file(path);
    std::printf("%s: HDF5, %zu bytes, SHA-256 %s\n", path.c_str(), file.bytes.size(), sha256.c_str());
    for (const PublishedDataSet& set : published_data_sets) {
        if (sha256 == set.sha256) std::printf("This is D4RL's published file of %s.\n", set.id);
        if (id.empty() && (sha256 == set.sha256 || fs::path(path).filename() == file_name(set))) id = set.id;
    }
    constexpr size_t listed = 40;
    for (size_t i = 0; i < std::min(listed, file.datasets.size()); ++i) {
        const Hdf5Dataset& dataset = file.datasets[i];
        std::printf("  %-40s %-18s %-12s %zu bytes stored%s%s\n", json_string(dataset.path).c_str(),
                    shape_text(dataset.shape).c_str(), dataset.type.c_str(), dataset.stored,
                    dataset.unsupported.empty() ? "" : "; cannot be read: ", dataset.unsupported.c_str());
    }
    if (file.datasets.size() > listed) std::printf("  and %zu more\n", file.datasets.size() - listed);
    if (!is_minari(file) && !file.find("observations")) return;
    const Rows rows = is_minari(file) ? read_minari(file) : read_rows(file);
    const MujocoTask* task = find_mujoco_task(id);
    if (!task)
        std::printf("The name tells no task, so there is no score, and flags alone end trajectories (see --task)\n");
    const std::vector<Trajectory> trajectories = task ? cut_trajectories(rows, *task, path) : cut_at_flags(rows, 1000);
    const DataSetStatistics statistics = statistics_of(rows, trajectories);
    std::printf("rows:         %zu, %zu state and %zu action numbers\n%s", rows.count, rows.state_dim, rows.action_dim,
                describe(statistics).c_str());
    if (task)
        std::printf("mean normalised score of a trajectory: %.2f (%s)\n",
                    normalised_score(*task, statistics.returns.mean()), task->name);
    const PublishedDataSet* set = find_published(id);
    if (set && set->trajectories > 0 && std::isnan(set->deviation))
        std::printf("D4RL's: %d trajectories, mean return %.2f\n", set->trajectories, set->mean_return);
    else if (set && set->trajectories > 0)
        std::printf("D4RL's: %d trajectories, returns: mean %.2f, deviation %.2f, %.2f to %.2f\n", set->trajectories,
                    set->mean_return, set->deviation, set->low, set->high);
}

void command_info(const Arguments& arguments) {
    const std::string& path = arguments.words[0];
    if (is_hdf5(path))
        return describe_data_set(path, arguments["--task"].empty() ? "" : full_task_name(arguments["--task"]));
    const std::string bytes = read_file(path);
    const uint32_t checksum = crc32(bytes);
    const TensorFile file = parse_safetensors(bytes, path);
    std::printf("%s: safetensors, %zu bytes, crc32 %s\n", path.c_str(), bytes.size(), hex8(checksum).c_str());
    for (const auto& [key, text] : file.metadata) {
        std::string shown = key + (text.find('\n') == std::string::npos ? ": " : ":\n") + text;
        for (char& c : shown)
            if (static_cast<unsigned char>(c) < ' ' && c != '\n') c = '?';  // a file may not drive the terminal
        std::printf("%s%s", shown.c_str(), shown.ends_with('\n') ? "" : "\n");
    }
    for (const StoredTensor& tensor : file.tensors) {
        std::string range;
        if (tensor.dtype == DType::F32) range = value_range<float>(file, tensor);
        if (tensor.dtype == DType::F64) range = value_range<double>(file, tensor);
        if (tensor.dtype == DType::U8) range = value_range<uint8_t>(file, tensor);
        if (tensor.dtype == DType::U32) range = value_range<uint32_t>(file, tensor);
        if (tensor.dtype == DType::U64) range = value_range<uint64_t>(file, tensor);
        if (tensor.dtype == DType::I64) range = value_range<int64_t>(file, tensor);
        std::printf("%-44s %s %-14s %s\n", tensor.name.c_str(), about(tensor.dtype).name,
                    shape_text(tensor.shape).c_str(), range.c_str());
    }
}

void command_tasks(const Arguments& arguments) {
    if (!arguments.words.empty()) {
        std::printf("%s", settings_text(default_settings(arguments.words[0], arguments["--method"], "paper")).c_str());
        return;
    }
    const EnvironmentSpec spec = GridWorld{}.spec();
    std::printf("%-30s %3d state numbers, %d moves, at most %d steps; data set: a fixed policy's, made on the spot\n",
                "gridworld", spec.state_dim, spec.moves, spec.max_episode_steps);
    for (const std::string& id : split(task_names, '|'))
        if (const MujocoTask* task = find_mujoco_task(id))
            std::printf(
                "%-30s %3d state numbers, %d action numbers, at most %d steps; score 0 is a return of %s, 100 %s\n",
                id.c_str(), task->state_dim, task->action_dim, task->max_episode_steps,
                number_text(task->score_low).c_str(), number_text(task->score_high).c_str());
    std::printf("MuJoCo: %s%s%s\n", mujoco_version().c_str(), mujoco_version() == "none" ? "; " : "",
                mujoco_version() == "none" ? mujoco_advice : "");
}

#include "tests/bench.hpp"
#include "tests/check.hpp"

void command_bench(const Arguments& arguments) {
    kernel_named(arguments["--kernel"]);  // refuses what the machine lacks
    const int threads = thread_count(arguments);
    const std::string what = arguments.words.empty() ? "updates" : arguments.words[0];
    if (what != "updates" && what != "environments" && what != "random-policy")
        fail("usage.words", "bench cannot measure \"%s\"; it is updates, environments or random-policy", what.c_str());
    if (what != "updates") {
#ifdef WODTEM_MUJOCO
        std::printf("MuJoCo %s, uniformly random actions\n", mujoco_version().c_str());
        if (what == "random-policy") return bench_random_policy(threads);
        std::printf("one core, physics d4rl; medians of 25 rounds; overhead: beside the engine's calls alone\n");
        for (const MujocoTask& task : mujoco_tasks) bench_environment(task);
        return bench_learner(arguments["--kernel"], threads);
#else
        fail("mujoco.absent", "MuJoCo 2.2 was not there when this program was built; %s", mujoco_advice);
#endif
    }
    bench_all(arguments["--kernel"], threads, !arguments["--json"].empty());
}

const std::vector<Command>& commands() {
    static const std::vector<Command> list = {
        {"train",
         "TASK",
         1,
         1,
         "offline phase, online phase, evaluations; continues what is there",
         {method_option,
          preset_option,
          seed_option,
          seeds_option,
          set_option,
          physics_option,
          dataset_option,
          {"--weights", "MODEL", "", "begin with a model's network, temperature and normaliser, not with random ones"},
          {"--out", "DIR", "", "the run's folder (default: runs/TASK-PRESET-METHOD-SEED)"},
          kernel_option,
          threads_option,
          {"--checkpoint-every", "SECONDS", "30", "how much work a kill may cost; 0: save after each update"}},
         command_train},
        {"eval",
         "MODEL",
         1,
         1,
         "evaluate a saved model; needs nothing else",
         {{"--episodes", "N", "1", "episodes"}, kernel_option, threads_option},
         command_eval},
        {"export",
         "MODEL OUT",
         2,
         2,
         "write a model's weights for another program",
         {{"--odt", nullptr, "", "for load_state_dict(strict=True) of ODT's own code: its names, its unused tensors"}},
         command_export},
        {"import",
         "FILE OUT",
         2,
         2,
         "make a model of weights under ODT's names, in a safetensors file",
         {{"--task", "ID", "", "whose network it is; not needed if `wodtem export` made the file"},
          method_option,
          preset_option,
          set_option,
          physics_option,
          dataset_option,
          kernel_option},
         command_import},
        {"collect",
         "ID",
         1,
         1,
         "make a stand-in for one of D4RL's data sets, in its layout",
         {{"--out", "FILE", "", "where to write (default: runs/datasets under D4RL's file name)"},
          {"--steps", "N", "", "rows (default: as many as D4RL's)"},
          {"--policy", "FILE", "", "of a medium or antmaze set (default: the one that this program holds)"},
          {"--seed", "N", "0", "of all that is drawn"},
          threads_option},
         command_collect},
        {"trace",
         "TASK",
         1,
         1,
         "step a MuJoCo task from given states through given actions, to 17 digits",
         {physics_option},
         command_trace},
        {"report",
         "DIR...",
         1,
         10000,
         "tables and figures of runs: one HTML file, SVG files, Markdown",
         {{"--out", "DIR", "runs/report", "where to write"}},
         command_report},
        {"sweep",
         "[TASK]",
         0,
         1,
         "print one train command per method and seed, for any job runner",
         {{"--methods", "LIST", "dt,odt,wodtem", "methods, separated by commas"},
          {"--seeds", "A-B", "0-4", "seeds"},
          preset_option,
          {"--estimate", nullptr, "", "say how long the runs would take, as comments"}},
         command_sweep},
        {"info",
         "FILE",
         1,
         1,
         "what is in a data set, a model or a checkpoint, and what it means",
         {{"--task", "ID", "", "of a data set whose name does not tell"}},
         command_info},
        {"bench",
         "[WHAT]",
         0,
         1,
         "updates: kernels beside the machine's peak, look-ups; environments: steps a second, of learning too; random-policy",
         {kernel_option, threads_option, {"--json", nullptr, "", "of updates: print one JSON array"}},
         command_bench},
        {"check",
         "FILE...",
         0,
         10000,
         "recompute golden vectors, ours or yours, and compare",
         {{"-v", nullptr, "", "print inputs, expected and got"},
          {"--dump", "FILE", "", "write every tensor of one update of a run instead, as a case of topic step"},
          {"--run", "DIR", "", "of this run: its next update if it has a checkpoint, else its first; dropout off"},
          dataset_option,
          kernel_option,
          threads_option},
         command_check},
        {"tasks",
         "[TASK]",
         0,
         1,
         "list tasks, or the settings of one with their sources",
         {method_option},
         command_tasks},
    };
    return list;
}

void print_help(const Command* command) {
    if (!command) {
        std::printf(
            "wodtem: decision transformers that go from offline data to online interaction, with an episodic memory\n\n");
        for (const Command& c : commands()) std::printf("  wodtem %-7s%-9s %s\n", c.name, c.words, c.meaning);
        std::printf("\nwodtem COMMAND --help lists a command's options. Try: wodtem train gridworld --method wodtem\n");
        return;
    }
    std::printf("wodtem %s %s\n%s\n\n", command->name, command->words, command->meaning);
    for (const Option& option : command->options) {
        const std::string left = std::string(option.name) + " " + (option.value ? option.value : "");
        std::printf("  %-26s %s%s%s\n", left.c_str(), option.meaning, *option.fallback ? "; default " : "",
                    option.fallback);
    }
    if (std::string(command->name) == "trace")
        std::printf(
            "\nStandard input, line by line:\n"
            "  init qpos,...   with the next line starts a segment: mj_resetData, write both, mj_forward\n"
            "  init qvel,...   answered by one line: init obs,...\n"
            "  goal,X,Y        mazes: the goal from here on, in observed coordinates\n"
            "  ...,...         an action as a policy gives it; answered by one line: obs...,reward,done\n"
            "Nothing ends an episode but the next init.\n");
    if (std::string(command->name) == "collect") {
        std::printf("\nID, rows, and how long it takes on one core:\n");
        for (const PublishedDataSet& set : published_data_sets)
            std::printf("  %-30s %8zu  %s\n", set.id, set.steps, set.collected_in);
        std::printf("  %-30s %8s  the policy of the antmaze sets, trained anew; 60,000 updates\n", walker_name, "");
        std::printf("A training that was stopped goes on with the same command.\n");
    }
    if (std::string(command->name) == "train") {
        std::printf("\nSettings for --set, with the values of preset paper:\n");
        const Settings settings;
        for (const SettingRow& row : setting_rows)
            std::printf("  %-24s %-12s %s\n", row.name, setting_text(settings, row).c_str(), row.source);
    }
}

Arguments parse_arguments(const Command& command, const std::vector<std::string>& words) {
    Arguments arguments;
    std::set<std::string> seen;
    std::vector<std::string> names;
    for (const Option& option : command.options)
        arguments.options[option.name] = option.fallback, names.push_back(option.name);
    for (size_t i = 0; i < words.size(); ++i) {
        if (!words[i].starts_with("-") || words[i].size() < 2) {
            arguments.words.push_back(words[i]);
            continue;
        }
        const auto option = std::find_if(command.options.begin(), command.options.end(),
                                         [&](const Option& o) { return words[i] == o.name; });
        if (option == command.options.end()) {
            if (names.empty())
                fail("usage.option", "wodtem %s has no options; \"%s\" was given", command.name, words[i].c_str());
            fail("usage.option", "wodtem %s has no option \"%s\"; the nearest is %s", command.name, words[i].c_str(),
                 nearest_name(words[i], names).c_str());
        }
        if (!option->value) {
            arguments.options[option->name] = "yes";
            continue;
        }
        if (i + 1 == words.size() || words[i + 1].starts_with("--"))
            fail("usage.option", "option %s needs a value: %s", option->name, option->value);
        const std::string& value = words[++i];
        if (value.empty())
            fail("usage.option", "option %s needs a value that is not empty: %s", option->name, option->value);
        if (std::string(option->name) == "--set") {
            arguments.assignments.push_back(value);
            continue;
        }
        if (!seen.insert(option->name).second) fail("usage.option", "option %s is given twice", option->name);
        arguments.options[option->name] = value;
    }
    if (arguments.words.size() < command.least_words || arguments.words.size() > command.most_words)
        fail("usage.words", "wodtem %s takes %s; %zu argument%s given (wodtem %s --help)", command.name,
             *command.words ? command.words : "no argument", arguments.words.size(),
             arguments.words.size() == 1 ? " was" : "s were", command.name);
    return arguments;
}

int run_command_line(const std::vector<std::string>& words) {
    const auto asks_for_help = [](const std::string& word) {
        return word == "--help" || word == "-h" || word == "help";
    };
    const auto flush = [] {
        if (std::fflush(stdout) != 0 || std::ferror(stdout))
            fail("console.write", "cannot write the results to stdout: is the disk full?");
    };
    if (words.empty() || asks_for_help(words[0])) {
        print_help(nullptr);
        flush();
        return words.empty() ? 2 : 0;
    }
    std::vector<std::string> names;
    for (const Command& command : commands()) {
        names.push_back(command.name);
        if (words[0] != command.name) continue;
        const std::vector<std::string> rest(words.begin() + 1, words.end());
        if (std::any_of(rest.begin(), rest.end(), asks_for_help))
            print_help(&command);
        else
            command.run(parse_arguments(command, rest));
        flush();
        return 0;
    }
    fail("usage.command", "unknown command \"%s\"; the nearest is %s (wodtem --help lists all)", words[0].c_str(),
         nearest_name(words[0], names).c_str());
}

#ifndef WODTEM_NO_MAIN
int main(int argument_count, char** arguments) {
    std::signal(SIGPIPE, SIG_IGN);  // a closed pipe is an error of write, told in a sentence
    std::signal(SIGXFSZ, SIG_IGN);  // and so is a file size limit
    try {
        return run_command_line({arguments + 1, arguments + argument_count});
    } catch (const Error& error) {
        std::fprintf(stderr, "wodtem: %s\n", error.what());
        return error.id.starts_with("usage.") ? 2 : 1;
    } catch (const std::bad_alloc&) {
        std::fprintf(stderr, "wodtem: out of memory\n");
    } catch (const std::exception& error) {
        std::fprintf(stderr, "wodtem: %s\n", error.what());
    }
    return 1;
}
#endif
