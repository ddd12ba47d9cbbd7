// settings.hpp: every number and word that decides a run, each with its source, and their text form.
//
// `setting_rows` is the table of settings: name, range, and the source of the grid world's value (WODTEM Table I);
// `task_rows` is what the D4RL tasks change (WODTEM Table II, sec. V-C, ODT's code); `small_rows` is preset small.
// A run folder's file `settings` and a model's metadata hold the text form, one line a setting:
//
//   name = value                            # source
//   name = "value"                          # source: with \xHH for bytes that would not read back as they are
//
// Promises: what is written reads back as the same settings; what is not in the table, out of its range or missing is
// an error that names the line, the setting and the nearest value. Leaves out: the command line (command_line.hpp).
// The file has first what all of data/ uses, text, means and deviations; then the tables; then settings by name, as
// text and as parts.
// The other headers of data/ that include this one have what it includes.
#pragma once

#include <cctype>
#include <set>
#include <variant>

#include "../gridworld.hpp"
#include "../mujoco_env.hpp"
#include "safetensors.hpp"  // and with it the other standard headers

// ---------------------------------------------------------------------------------------------------------------------
// Text.

// The parts of a text between separators; "" is one empty part.
inline std::vector<std::string> split(const std::string& text, char separator) {
    std::vector<std::string> parts(text.empty() ? 1 : 0);
    for (const auto part : std::views::split(text, separator)) parts.emplace_back(part.begin(), part.end());
    return parts;
}

inline std::string trimmed(std::string_view text) {
    const size_t first = text.find_first_not_of(" \t");
    if (first == std::string_view::npos) return "";
    return std::string(text.substr(first, text.find_last_not_of(" \t") + 1 - first));
}

inline bool contains(const auto& all, const auto& one) { return std::ranges::find(all, one) != std::end(all); }

// The shortest text that reads back as the same number, of whatever type it is.
inline std::string number_text(auto x) {
    char text[32];
    return {text, std::to_chars(text, text + sizeof text, x).ptr};
}

// A text as it is; yes or no; or number_text().
template <class Value>
std::string value_text(const Value& value) {
    if constexpr (std::is_same_v<Value, bool>)
        return value ? "yes" : "no";
    else if constexpr (std::is_arithmetic_v<Value>)
        return number_text(value);
    else
        return value;
}

// A finite number that takes up the whole text, or nothing.
inline std::optional<double> to_number(const std::string& text) {
    double x = 0;
    const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), x);
    if (error != std::errc() || end != text.data() + text.size() || !std::isfinite(x)) return std::nullopt;
    return x;
}

// The numbers of a line, between commas and perhaps blanks, which are finite also as float32, the type of states and
// actions. refuse(part) throws, for a part that is none.
inline std::vector<double> numbers_between_commas(const std::string& line, const auto& refuse) {
    std::vector<double> values;
    for (const std::string& part : split(line, ',')) {
        values.push_back(to_number(trimmed(part)).value_or(NAN));
        if (!std::isfinite(static_cast<float>(values.back()))) refuse(part);
    }
    return values;
}

constexpr size_t most_quoted = 200;  // bytes of a given text in a sentence

// A text as a sentence quotes it.
inline std::string excerpt(const std::string& text) {
    return text.size() > most_quoted ? text.substr(0, most_quoted) + "..." : text;
}

// The number in a text, from `low` to `high`, and whole if it must be. Errors: `id` with the range and the nearest
// number in it; `name` begins the sentence.
inline double number_in(const std::string& text, const char* id, const char* name, auto low, auto high, bool whole) {
    const double least = static_cast<double>(low), most = static_cast<double>(high);
    const std::optional<double> x = to_number(text);
    const double within = std::clamp(x.value_or(least), least, most), nearest = whole ? std::round(within) : within;
    require(x == nearest, id, name, " cannot be \"", excerpt(text), "\"; it is a ", whole ? "whole " : "",
            "number from ", number_text(low), " to ", number_text(high),
            x ? "; the nearest is " + number_text(static_cast<decltype(low)>(nearest)) : "");
    return *x;
}

// `text` as one word of a shell command: between single quotes where a character could mean something to a shell.
inline std::string shell_word(const std::string& text) {
    const auto plain = [](unsigned char c) { return std::isalnum(c) || std::strchr("_-+=.,:/@%", c); };
    if (!text.empty() && std::all_of(text.begin(), text.end(), plain)) return text;
    std::string word = "'";
    for (const char c : text) word += c == '\'' ? std::string("'\\''") : std::string(1, c);
    return word + "'";
}

// Levenshtein distance: the number of letters to insert, remove or replace.
inline int edit_distance(const std::string& a, const std::string& b) {
    std::vector<int> row(b.size() + 1);  // of the prefix of a, to each prefix of b
    for (size_t j = 0; j <= b.size(); ++j) row[j] = static_cast<int>(j);
    for (size_t i = 1; i <= a.size(); ++i) {
        int diagonal = row[0]++;
        for (size_t j = 1; j <= b.size(); ++j) {
            const int replaced = diagonal + (a[i - 1] != b[j - 1]);
            diagonal = row[j];
            row[j] = std::min({row[j] + 1, row[j - 1] + 1, replaced});
        }
    }
    return row[b.size()];
}

// The name with the least edit distance; of several, the first.
inline std::string nearest_name(const std::string& name, const std::vector<std::string>& names) {
    return std::ranges::min(names, {}, [&](const std::string& other) { return edit_distance(name, other); });
}

// '; the nearest is "NAME"' for the end of a sentence; nothing where none of the names is near: where more than half of
// the letters would have to change, and neither is a part of the other; or where the text is longer than most_quoted,
// for which the distances would take long.
inline std::string nearest_hint(const std::string& name, const std::vector<std::string>& names) {
    if (name.size() > most_quoted) return "";
    const std::string nearest = nearest_name(name, names);
    const bool part = nearest.find(name) != std::string::npos || name.find(nearest) != std::string::npos;
    const size_t longer = std::max(name.size(), nearest.size());
    const bool near = part || 2 * static_cast<size_t>(edit_distance(name, nearest)) <= longer;
    return near ? "; the nearest is \"" + nearest + "\"" : "";
}

// The row of a table that has this name. `sentence` is a format of two texts: the name, and the hint to the nearest.
// Errors: `id`, if there is none.
inline const auto& row_named(const auto& rows, const std::string& name, const char* id, const std::string& sentence) {
    std::vector<std::string> names;
    for (const auto& row : rows) {
        if (name == row.name) return row;
        names.push_back(row.name);
    }
    fail(id, sentence.c_str(), excerpt(name).c_str(), nearest_hint(name, names).c_str());
}

// The index of `name` among an enumeration's names, which hold it.
template <size_t N>
int index_of(const std::array<const char*, N>& names, const std::string& name) {
    return static_cast<int>(std::find(names.begin(), names.end(), name) - names.begin());
}

// ---------------------------------------------------------------------------------------------------------------------
// Means and deviations.

// Of the numbers that were added. The mean and both deviations of none are NaN, as is the sample's deviation of one.
struct Moments {
    double count = 0, sum = 0, squares = 0, low = INFINITY, high = -INFINITY;  // squares: of distances from the mean
    void add(double x) {
        const double off = count > 0 ? x - mean() : 0;
        ++count;
        sum += x;
        squares += off * (x - mean());  // Welford's update
        low = std::min(low, x);
        high = std::max(high, x);
    }
    double mean() const { return sum / count; }
    double deviation() const { return std::sqrt(squares / count); }  // of the numbers as they are, as D4RL's statistics
    double sample_deviation() const { return count > 1 ? std::sqrt(squares / (count - 1)) : NAN; }
    std::string text() const {
        if (count == 0) return "none";
        char line[160];
        std::snprintf(line, sizeof line, "mean %.2f, deviation %.2f, %.2f to %.2f", mean(), deviation(), low, high);
        return line;
    }
};

// Of those values that are not NaN.
inline Moments moments_of(const std::vector<double>& values) {
    Moments moments;
    for (const double value : values)
        if (!std::isnan(value)) moments.add(value);
    return moments;
}

// ---------------------------------------------------------------------------------------------------------------------
// The tables.

struct OwnData;  // d4rl.hpp

// The initial values are those of the paper's grid world.
struct Settings {
    std::string task = "gridworld", method = "wodtem", preset = "small", arithmetic = "fused";
    std::string physics = "none", mujoco = "none", dataset = "none", dataset_sha256 = "none", first_weights = "none";
    int64_t seed = 0;
    int64_t state_dim = 0, action_dim = 0, moves = 0;  // of own data alone

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
    bool keep_lowest = false, clip_actions = false;
    std::string sampling = "uniform", cut = "flags";
    double held_out = 0;

    double gamma = 0.99, alpha = 0.75, epsilon = 0.1, tau = 1;
    int64_t K = 1, projected_dim = 0, table_size = 36;
    std::string keys = "raw", eviction = "lfu";
    bool exclude_self = false;

    std::string behaviour = "right_down", edge = "clipped", state_encoding = "coordinates";
    int64_t data_trajectories = 500, data_seed = default_data_seed;

    std::map<std::string, std::string> source;  // name -> source, of values that differ from `setting_rows`
    std::string dataset_path, weights_path;     // not settings: a run may continue on another machine
    std::shared_ptr<const OwnData> own;         // nor this: what own data's file holds, where it has been read
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
    "gridworld|hopper-medium-v2|hopper-medium-replay-v2|hopper-random-v2|hopper-medium-expert-v2|hopper-expert-v2|"
    "hopper-full-replay-v2|walker2d-medium-v2|walker2d-medium-replay-v2|walker2d-random-v2|walker2d-medium-expert-v2|"
    "walker2d-expert-v2|walker2d-full-replay-v2|halfcheetah-medium-v2|halfcheetah-medium-replay-v2|"
    "halfcheetah-random-v2|halfcheetah-medium-expert-v2|halfcheetah-expert-v2|halfcheetah-full-replay-v2|"
    "ant-medium-v2|ant-medium-replay-v2|ant-random-v2|ant-medium-expert-v2|ant-expert-v2|ant-full-replay-v2|"
    "antmaze-umaze-v2|antmaze-umaze-diverse-v2|maze2d-umaze-v1|maze2d-medium-v1|maze2d-large-v1|hopper-v2|"
    "walker2d-v2|halfcheetah-v2|ant-v2|data";
constexpr const char* own_data = "data";  // the task of a data set that belongs to none of the others
constexpr double many = 1e9;
// WODTEM Table I: each row is the source of a value below.
inline const SettingRow setting_rows[] = {
    {"task", &Settings::task, 0, 0, task_names, "command line"},
    {"method", &Settings::method, 0, 0, "dt|odt|wodtem", "command line"},
    {"preset", &Settings::preset, 0, 0, "paper|small|reduced", "command line"},
    {"seed", &Settings::seed, 0, 4294967295, "", "command line"},
    {"arithmetic", &Settings::arithmetic, 0, 0, "fused|plain|bf16",
     "the kernel: multiply-add with one rounding or two, or of numbers rounded to bf16"},
    {"physics", &Settings::physics, 0, 0, "none|d4rl|2.2", "the task has no bodies"},
    {"mujoco", &Settings::mujoco, 0, 0, "", "the library's version"},
    {"dataset", &Settings::dataset, 0, 0, "", "made on the spot"},
    {"dataset_sha256", &Settings::dataset_sha256, 0, 0, "", "of the file"},
    {"first_weights", &Settings::first_weights, 0, 0, "", "none: drawn from the seed"},
    {"state_dim", &Settings::state_dim, 0, 1e5, "", "the task's own: 0 stands for it"},
    {"action_dim", &Settings::action_dim, 0, 1e5, "", "the task's own: 0 stands for it"},
    {"moves", &Settings::moves, 0, 1e4, "", "the task's own: 0 stands for it"},
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
    {"sampling", &Settings::sampling, 0, 0, "by_length|uniform",
     "chosen: so ODT ends near the paper's 7; DT's and ODT's code: by_length"},
    {"cut", &Settings::cut, 0, 0, "flags|episodes",
     "D4RL's and ODT's code; episodes (maze2d): at the time limit alone"},
    {"clip_actions", &Settings::clip_actions, 0, 0, "", "chosen: recorded actions beyond 1 are refused"},
    {"held_out", &Settings::held_out, 0, 0.9, "", "the paper trains on all trajectories"},
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

// What the D4RL tasks change; later rows override earlier ones. A row holds for tasks whose name begins with `task` and
// for `method`; "" stands for all. `values`: NAME=VALUE, separated by blanks. ODT's paper prints no such table: values
// marked "unverified" have no source, values marked "one public reproduction" a single one.
struct TaskRow {
    const char *task, *method, *values, *source;
};
// WODTEM Table II: each row likewise.
inline const TaskRow task_rows[] = {
    {"", "",
     "layers=4 heads=4 width=512 context_length=20 position=no learning_rate=1e-4 weight_decay=5e-4 "
     "offline_updates=5000 updates_per_iteration=300 buffer_size=1000 eval_episodes=10 reward_scale=0.001 "
     "sampling=by_length",
     "ODT's code"},
    {"", "", "online_steps=200000 gamma=0.99 epsilon=0.1 projected_dim=4 table_size=2e6 alpha=0.9 K=2",
     "WODTEM sec. V-C"},
    {"", "", "physics=d4rl", "chosen: as MuJoCo up to 2.1.0, which made D4RL's data"},
    {"", "", "behaviour=recorded", "the data set"},
    {"", "", "data_trajectories=10", "chosen, of random actions: enough to normalise states by"},
    {"", "", "data_seed=0", "chosen"},
    {"hopper", "", "g_eval=3600 g_online=7200", "ODT's code"},
    {"hopper-medium-replay", "", "learning_rate=2e-3 weight_decay=1e-4", "one public reproduction of ODT"},
    {"walker2d", "", "learning_rate=1e-3 weight_decay=1e-3 offline_updates=10000 g_eval=5000 g_online=10000",
     "public reproductions of ODT agree"},
    {"walker2d", "", "epsilon=0.2", "WODTEM sec. V-C"},
    {"halfcheetah", "", "g_eval=6000 g_online=12000", "public reproductions of ODT agree"},
    {"halfcheetah", "", "epsilon=0.6", "WODTEM sec. V-C"},
    {"ant-", "", "g_eval=6000 g_online=12000", "unverified"},
    {"ant", "", "epsilon=0.3", "WODTEM sec. V-C"},
    {"antmaze", "",
     "width=1024 position=yes learning_rate=1e-3 weight_decay=0 offline_updates=7000 buffer_size=1500 g_eval=1 "
     "g_online=2",
     "one public reproduction of ODT"},
    {"antmaze", "", "reward_scale=1", "ODT's code"},
    {"maze2d", "", "layers=4", "WODTEM Table II: number of layers"},
    {"maze2d", "", "heads=4", "WODTEM Table II: number of attention heads"},
    {"maze2d", "", "width=512", "WODTEM Table II: embedding dimension"},
    {"maze2d", "", "context_length=20", "WODTEM Table II: context length"},
    {"maze2d", "", "learning_rate=1e-3", "WODTEM Table II: learning rate"},
    {"maze2d", "", "weight_decay=0", "WODTEM Table II: weight decay"},
    {"maze2d", "", "offline_updates=20000", "WODTEM Table II: offline training updates"},
    {"maze2d", "", "updates_per_iteration=300", "WODTEM Table II: online training updates per iteration"},
    {"maze2d", "", "buffer_size=1500", "WODTEM Table II: buffer size"},
    {"maze2d", "", "position=yes", "WODTEM Table II: position"},
    {"maze2d", "", "g_online=560", "WODTEM Table II: g_online"},
    {"maze2d", "", "g_eval=280", "WODTEM Table II: g_eval"},
    {"maze2d-umaze", "", "g_online=340", "WODTEM Table II: g_online"},
    {"maze2d-umaze", "", "g_eval=170", "WODTEM Table II: g_eval"},
    {"maze2d-large", "", "table_size=4e6", "WODTEM sec. V-C"},
    {"", "dt",
     "layers=3 heads=1 width=128 eval_context=20 position=yes optimizer=adamw learning_rate=1e-4 weight_decay=1e-4 "
     "batch_size=64 offline_updates=100000",
     "DT's code"},
    {"maze2d", "dt", "reward_scale=1", "chosen: as others' DT on maze2d"},
    {"data", "", "physics=none", "there is no environment"},
    {"data", "", "held_out=0.1", "chosen: for measuring, since nothing can be evaluated by acting"},
};

// Preset small: what it changes of preset paper, so that a run takes half an hour on two cores. All three methods share
// one network and one schedule, so that only the objective differs.
inline const TaskRow small_rows[] = {
    {"", "", "layers=2 heads=2 width=64 offline_updates=6000 updates_per_iteration=100", "preset small"},
    {"", "", "context_length=1", "preset small: states tell all; more windows instead of longer ones"},
    {"", "", "batch_size=256", "preset small: ODT's"},
    {"", "", "position=no", "preset small: maze2d's data end after 230 steps; later rows of the table would not learn"},
    {"", "", "learning_rate=1e-3", "preset small: a narrow network and few updates"},
    {"", "", "warmup_updates=1000", "preset small: a tenth of ODT's"},
    {"", "dt", "offline_updates=12700", "preset small: as many as the others make, where episodes have 300 steps"},
    {"", "", "online_steps=20000", "preset small: a tenth of WODTEM's"},
    {"maze2d", "", "reward_scale=1", "preset small: at ODT's 0.001 returns-to-go, at most 0.055, are not heeded"},
    {"maze2d", "", "buffer_size=4000", "preset small: the best 1500 trajectories all leave the goal"},
};

// Preset reduced: Table II's schedule (updates, updates an episode, buffer, learning rate, returns, interactions) with
// a small network: a maze2d run took 4 to 6 minutes. maze2d's data are cut every max_episode_steps rows: under the
// flags the 1500 best trajectories all leave the goal. Machine, date and evidence: data/RESULTS.md.
inline const TaskRow reduced_rows[] = {
    {"", "", "layers=1 heads=2 width=64 batch_size=128 dropout=0", "preset reduced"},
    {"", "", "context_length=1 position=no", "preset reduced: a state needs no history"},
    {"", "", "eval_episodes=20 eval_every=30", "preset reduced: evaluations of one network differ widely"},
    {"maze2d", "", "reward_scale=0.01 cut=episodes", "preset reduced"},
};

// ---------------------------------------------------------------------------------------------------------------------
// Reading and changing settings by name.

// Errors: usage.setting names the nearest setting.
inline const SettingRow& setting_row(const std::string& name) {
    return row_named(setting_rows, name, "usage.setting", "unknown setting \"%s\"%s");
}

inline std::string setting_text(const Settings& settings, const SettingRow& row) {
    return std::visit([&](auto field) { return value_text(settings.*field); }, row.field);
}

// A value's text is checked by its type: a word against the choices of its row, a number against its range. Errors of
// the three functions: usage.setting with what is allowed.
inline void parse_value(const SettingRow& row, const std::string& text, std::string& value) {
    const std::vector<std::string> choices = split(row.choices, '|');
    if (*row.choices != 0 && !contains(choices, text))
        fail("usage.setting", "%s cannot be \"%s\"; it is one of %s%s", row.name, excerpt(text).c_str(), row.choices,
             nearest_hint(text, choices).c_str());
    value = text;
}

inline void parse_value(const SettingRow& row, const std::string& text, bool& value) {
    require(text == "yes" || text == "no", "usage.setting", row.name, " cannot be \"", excerpt(text),
            "\"; it is yes or no");
    value = text == "yes";
}

template <class Number>
void parse_value(const SettingRow& row, const std::string& text, Number& value) {
    constexpr bool whole = std::is_integral_v<Number>;
    value = static_cast<Number>(number_in(text, "usage.setting", row.name, row.low, row.high, whole));
}

inline void set_setting(Settings& settings, const std::string& name, const std::string& text) {
    const SettingRow& row = setting_row(name);
    std::visit([&](auto field) { parse_value(row, text, settings.*field); }, row.field);
}

// `source`: the command line, the preset, the method or a row of `task_rows`.
inline void set_from(Settings& settings, const std::string& name, const std::string& text, const std::string& source) {
    set_setting(settings, name, text);
    settings.source[name] = source;
}

// The full id of a task whose version may have been left off: hopper-medium is hopper-medium-v2.
inline std::string full_task_name(const std::string& name) {
    for (const std::string& task : split(task_names, '|'))
        if (task.starts_with(name + "-v") && task.size() == name.size() + 3) return task;
    return name;
}

// Errors: usage.setting for an unknown task, method or preset.
inline Settings default_settings(const std::string& task, const std::string& method, const std::string& preset) {
    Settings settings;
    set_setting(settings, "task", full_task_name(task));
    set_setting(settings, "method", method);
    set_setting(settings, "preset", preset);
    const bool gridworld = settings.task == "gridworld";
    const auto apply = [&](std::span<const TaskRow> rows) {
        for (const TaskRow& row : rows)
            if (!gridworld && settings.task.starts_with(row.task) && (*row.method == 0 || method == row.method))
                for (const std::string& assignment : split(row.values, ' '))
                    set_from(settings, assignment.substr(0, assignment.find('=')),
                             assignment.substr(assignment.find('=') + 1), row.source);
    };
    apply(task_rows);
    if (const MujocoTask* mujoco = find_mujoco_task(settings.task))
        set_from(settings, "eta", std::to_string(-mujoco->action_dim), "ODT's code: minus the action dimensions");
    if (preset == "small" && gridworld) set_from(settings, "width", "8", "preset small: everything else as in Table I");
    if (preset == "small") apply(small_rows);
    require(preset != "reduced" || !gridworld, "usage.setting",
            "preset reduced is for MuJoCo's tasks; the grid world has small and paper");
    if (preset == "reduced") apply(reduced_rows);
    if (settings.task == own_data) set_from(settings, "online_steps", "0", "there is no environment");
    if (method == "dt") {
        set_from(settings, "online_steps", "0", "DT learns offline only");
        for (const char* name : {"layers", "heads", "width", "context_length", "learning_rate", "weight_decay",
                                 "offline_updates", "position"})
            if (gridworld && !settings.source.contains(name))
                settings.source[name] = "chosen for DT: as ODT's in Table I, so that only the objective differs";
    }
    return settings;
}

// Conditions on several settings at once. Errors: usage.setting.
inline void check_together(const Settings& s) {
    const auto rule = [](bool holds, const auto&... parts) { require(holds, "usage.setting", parts...); };
    rule(s.width % s.heads == 0, "width ", s.width, " is not a multiple of heads ", s.heads, "; the nearest width is ",
         (s.width / s.heads + 1) * s.heads);
    rule(s.batch_size * s.context_length <= 1000000, "batch_size ", s.batch_size, " times context_length ",
         s.context_length, " is more than a million steps in one update");
    rule(s.cut != "episodes" || s.task.starts_with("maze2d"),
         "cut=episodes is for maze2d, whose file is one walk without an end; ", s.task, " has cut=flags");
    rule(s.method != "dt" || s.online_steps == 0, "method dt learns offline only: online_steps must be 0, not ",
         s.online_steps);
    const bool gridworld = s.task == "gridworld", own = s.task == own_data;
    rule(!own || (s.state_dim > 0 && s.action_dim > 0 && (s.moves == 0 || s.action_dim == 1)),
         "the task data is chosen by giving a file: wodtem train FILE.hdf5");
    const int64_t outputs = std::max(s.moves, s.action_dim);  // the head's rows are orthonormal
    rule(!own || outputs <= s.width || (s.moves == 0 && s.method == "dt"), "width ", s.width, " is less than the ",
         outputs, " moves or action numbers; give --set width=", divide_up(outputs, s.heads) * s.heads, " or more");
    rule(!own || s.behaviour == "recorded", "own data have behaviour recorded");
    rule(!own || s.online_steps == 0, "online_steps must be 0, not ", s.online_steps, ": own data have no environment");
    rule(own || s.held_out == 0, "held_out is for own data; others are evaluated by acting");
    rule(!s.clip_actions || (!gridworld && s.moves == 0),
         "the actions are moves, which cannot be clipped: clip_actions must be no");
    rule((gridworld || own) == (s.physics == "none"), s.task, " cannot have physics ", s.physics, "; it is ",
         gridworld || own ? "none: there are no bodies" : "d4rl or 2.2");
    rule(gridworld != (s.behaviour == "random" || s.behaviour == "recorded"), s.task, " cannot have behaviour ",
         s.behaviour, "; it is ", gridworld ? "right_down or left_down" : "recorded or random");
}

// ---------------------------------------------------------------------------------------------------------------------
// The text form.

// Returns the value as it is, or between quotes if it would not read back so: a file's name may hold any byte but NUL.
inline std::string quoted(const std::string& value) {
    const bool utf8 = is_utf8(value);
    const auto special = [&](char c) { return is_control(c) || c == '"' || c == '#' || (c < 0 && !utf8); };
    if (!value.empty() && trimmed(value) == value && std::ranges::none_of(value, special)) return value;
    std::string text;
    for (const char c : value)
        text += special(c) || c == '\\' ? "\\x" + hex8(static_cast<uint8_t>(c)).substr(6) : std::string(1, c);
    return '"' + text + '"';
}

// The inverse of quoted(). A text that it cannot have written is a value as it is: earlier versions had no quotes.
inline std::string unquoted(const std::string& text) {
    if (text.size() < 2 || text.front() != '"' || text.back() != '"') return text;
    std::string value;
    for (size_t at = 1; at + 1 < text.size(); ++at) {
        if (text[at] == '"') return text;
        value += text[at];
        if (text[at] != '\\') continue;
        const std::string_view code = std::string_view(text).substr(at, 4);  // \xHH
        uint8_t byte = 0;
        const char* const end = code.data() + code.size();
        if (!code.starts_with("\\x") || std::from_chars(code.data() + 2, end, byte, 16).ptr != end) return text;
        value.back() = static_cast<char>(byte);
        at += 3;
    }
    return value;
}

inline std::string source_of(const Settings& settings, const SettingRow& row) {
    const auto source = settings.source.find(row.name);
    return source == settings.source.end() ? row.source : source->second;
}

// A setting that came later: files do not have it where nothing has set it, and so are as they were before.
inline bool is_later(const SettingRow& row) {
    constexpr std::string_view later[] = {"clip_actions", "held_out", "state_dim", "action_dim", "moves"};
    return contains(later, row.name);
}

inline std::string settings_text(const Settings& settings) {
    std::string text;
    for (const SettingRow& row : setting_rows) {
        if (is_later(row) && !settings.source.contains(row.name)) continue;
        std::string line = std::string(row.name) + " = " + quoted(setting_text(settings, row));
        line.resize(std::max<size_t>(line.size() + 1, 40), ' ');
        text += line + "# " + source_of(settings, row) + "\n";
    }
    return text;
}

struct Setting {
    std::string name, value;
    std::string source;  // "command line": a command that repeats the run must give the setting again
};

// The lines of a text form, before they are checked against the table. Blank lines and lines that begin with # are
// skipped; the first " = " of a line ends the name, the first " # " after it ends the value. Errors: settings.line,
// settings.repeated.
inline std::vector<Setting> parse_settings(const std::string& text, const std::string& path) {
    std::vector<Setting> out;
    std::set<std::string> names;
    size_t line = 0;
    for (const std::string& all : split(text, '\n')) {
        ++line;
        if (trimmed(all).empty() || trimmed(all)[0] == '#') continue;
        const size_t equals = all.find(" = "), hash = all.find(" # ", equals);  // npos stays npos
        Setting setting;
        if (hash != std::string::npos)
            setting = {trimmed(all.substr(0, equals)), trimmed(all.substr(equals + 2, hash - equals - 2)),
                       trimmed(all.substr(hash + 2))};
        const bool complete = !setting.name.empty() && !setting.value.empty() && !setting.source.empty();
        require(complete, "settings.line", path, ": line ", line, ": expected \"name = value    # source\", got \"",
                excerpt(trimmed(all)), "\"");
        require(names.insert(setting.name).second, "settings.repeated", path, ": line ", line, ": \"",
                excerpt(setting.name), "\" was set before; keep one of the lines");
        setting.value = unquoted(setting.value);
        out.push_back(setting);
    }
    return out;
}

// `path` is named in errors: settings.value, settings.missing, and those of parse_settings().
inline Settings settings_from_text(const std::string& text, const std::string& path) {
    Settings settings;
    for (const auto& [name, value, source] : parse_settings(text, path)) {
        try {
            set_from(settings, name, value, source);
        } catch (const Error& error) {
            fail("settings.value", "%s: %s; is it damaged, or from another version?", path.c_str(), error.what());
        }
    }
    for (const SettingRow& row : setting_rows)
        require(settings.source.contains(row.name) || is_later(row), "settings.missing", path, ": setting ", row.name,
                " is missing; is it damaged, or from another version?");
    return settings;
}

// The settings of a run that is to go on with larger budgets, which have no other effect on what came before: more
// interactions, or more offline updates of a run that has no online phase yet. (Own data's rows of progress.csv lie at
// tenths of the budget that they were made under.)
inline Settings with_larger_budgets(Settings found, const Settings& wanted) {
    if (found.online_steps == 0) found.offline_updates = std::max(found.offline_updates, wanted.offline_updates);
    found.online_steps = std::max(found.online_steps, wanted.online_steps);
    return found;
}

// `where`: the file or folder that `found` was read from. Errors: run.other_settings.
inline void require_same_settings(const Settings& found, const Settings& wanted, const std::string& where) {
    for (const SettingRow& row : setting_rows) {
        const std::string was = setting_text(found, row), now = setting_text(wanted, row);
        const bool same_data = found.dataset_sha256 == wanted.dataset_sha256;  // whatever the file is called
        const std::string_view name = row.name;
        require(was == now || (name == "dataset" && same_data), "run.other_settings", where, " belongs to a run with ",
                name, " = ", was, ", but ", now, " was asked for; ",
                name == "arithmetic" ? "choose the kernel it was begun with (--kernel)"
                                     : "choose another folder with --out, or the same settings");
    }
}

// The command that makes a run of these settings, but for --out. Settings that were read from a file do not know paths:
// then the data set's file name and the checksum of the model stand in their places. The fused arithmetic needs no
// option: its kernels are the default where a machine has them.
inline std::string train_command(const Settings& settings) {
    const bool own = settings.task == own_data;
    const std::string file =
        settings.dataset_path.empty() ? settings.dataset : std::filesystem::absolute(settings.dataset_path).string();
    std::string command = "./wodtem train " + (own ? shell_word(file) : settings.task);
    const auto add = [&](const char* option, const std::string& value) {
        command += std::string(" ") + option + " " + shell_word(value);
    };
    add("--method", settings.method);
    add("--preset", settings.preset);
    add("--seed", std::to_string(settings.seed));
    if (settings.physics != "none") add("--dataset", file == "none" ? "random" : file);
    if (source_of(settings, setting_row("physics")) == "command line") add("--physics", settings.physics);
    if (settings.first_weights != "none")
        add("--weights", settings.weights_path.empty() ? "model-of-sha256-" + settings.first_weights
                                                       : std::filesystem::absolute(settings.weights_path).string());
    if (settings.arithmetic == "plain") add("--kernel", "portable");
    if (settings.arithmetic == "bf16") add("--precision", "bf16");
    if (settings.clip_actions) command += " --clip-actions";
    const std::set<std::string> written{"task", "method", "preset", "seed", "arithmetic", "physics", "clip_actions"};
    for (const SettingRow& row : setting_rows)
        if (source_of(settings, row) == "command line" && !written.contains(row.name))
            add("--set", std::string(row.name) + "=" + setting_text(settings, row));
    return command;
}

// ---------------------------------------------------------------------------------------------------------------------
// From settings to the parts they configure.

inline TransformerConfig transformer_config(const Settings& settings, const EnvironmentSpec& spec) {
    const bool discrete = spec.discrete_actions > 0;
    const Head continuous_head = settings.method == "dt" ? Head::deterministic : Head::squashed_gaussian;
    return {.state_dim = spec.state_dim,
            .action_dim = discrete ? spec.discrete_actions : spec.action_dim,  // a discrete action is a one-hot vector
            .layers = static_cast<int>(settings.layers),
            .heads = static_cast<int>(settings.heads),
            .width = static_cast<int>(settings.width),
            .max_timesteps = settings.position ? 1000 : 0,  // ODT's code: a table of 1000 rows
            .dropout = static_cast<float>(settings.dropout),
            .head = discrete ? Head::categorical : continuous_head};
}

inline OptimizerConfig optimizer_config(const Settings& settings) {
    using Rule = OptimizerConfig::Rule;
    return {.rule = settings.optimizer == "lamb" ? Rule::lamb : Rule::adamw,
            .learning_rate = settings.learning_rate,
            .weight_decay = settings.weight_decay,
            .always_adapt = settings.lamb_always_adapt,
            .clip_norm = settings.clip_norm,
            .warmup_updates = static_cast<uint64_t>(settings.warmup_updates)};
}

inline MemoryConfig memory_config(const Settings& settings, const EnvironmentSpec& spec) {
    return {.state_dim = spec.state_dim,
            .action_dim = spec.action_dim,
            .projected_dim = static_cast<int>(settings.projected_dim),
            .capacity = static_cast<size_t>(settings.table_size),
            .K = static_cast<int>(settings.K),
            .epsilon = settings.epsilon,
            .tau = settings.tau,
            .exclude_self = settings.exclude_self,
            .eviction = settings.eviction == "lfu" ? Eviction::lfu : Eviction::lru};
}

inline GridWorld make_grid_world(const Settings& settings) {
    GridWorld world;
    world.edge = static_cast<EdgeRule>(index_of(edge_rule_names, settings.edge));
    world.encoding = static_cast<StateEncoding>(index_of(state_encoding_names, settings.state_encoding));
    return world;
}

// What stands in the place of an environment for own data. Errors of acting in it: data.environment.
struct NoEnvironment : Environment {
    EnvironmentSpec sizes;
    explicit NoEnvironment(const EnvironmentSpec& of_data) : sizes(of_data) {}
    EnvironmentSpec spec() const override { return sizes; }
    void reset(const Random&, uint64_t, float*) override {
        fail("data.environment", "own data have no environment to evaluate in; `wodtem act` gives a model's actions");
    }
    Step step(const float*, float*) override { return {0, true}; }
    std::unique_ptr<Environment> clone() const override { return std::make_unique<NoEnvironment>(*this); }
};

inline EnvironmentSpec spec_of(const Settings& settings) {
    if (settings.task == "gridworld") return make_grid_world(settings).spec();
    if (settings.task == own_data)
        return {static_cast<int>(settings.state_dim), static_cast<int>(settings.action_dim),
                static_cast<int>(settings.moves), 1};
    const MujocoTask& task = *find_mujoco_task(settings.task);
    return {task.state_dim, task.action_dim, 0, task.max_episode_steps};
}

// Errors: mujoco.absent in a program that was built without the library.
inline std::unique_ptr<Environment> make_environment(const Settings& settings) {
    if (settings.task == "gridworld") return make_grid_world(settings).clone();
    if (settings.task == own_data) return std::make_unique<NoEnvironment>(spec_of(settings));
#ifdef WODTEM_MUJOCO
    const int physics = index_of(physics_names, settings.physics);
    return std::make_unique<MujocoEnvironment>(*find_mujoco_task(settings.task), static_cast<Physics>(physics));
#else
    fail("mujoco.absent", "%s needs MuJoCo 2.2, which was not there when this program was built; %s",
         settings.task.c_str(), mujoco_advice);
#endif
}

// What folders and figures of a run are called after: the task, or data-FILE for own data, without the file's ending.
inline std::string data_name(const Settings& settings) {
    return settings.task == own_data ? "data-" + std::filesystem::path(settings.dataset).stem().string()
                                     : settings.task;
}

// The score of a return: D4RL's normalised score, and on the grid world the return itself.
inline double score_of(const Settings& settings, double total_return) {
    const MujocoTask* task = find_mujoco_task(settings.task);
    return task ? normalised_score(*task, total_return) : total_return;
}

// How many updates a run will make: exact for the offline phase; in the online phase episodes are taken to use up the
// time limit, and on the grid world to be as many as preset small's runs had on average (data/RESULTS.md).
inline double expected_updates(const Settings& settings) {
    double episodes = static_cast<double>(settings.online_steps) / spec_of(settings).max_episode_steps;
    if (settings.task == "gridworld" && settings.online_steps > 0) episodes = settings.method == "odt" ? 816 : 2844;
    return static_cast<double>(settings.offline_updates) +
           episodes * static_cast<double>(settings.updates_per_iteration);
}
