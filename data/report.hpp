// report.hpp: run folders in, tables and figures out: report.html (one file that needs nothing else), its figures as
// SVG files, and report.md. Answers WODTEM figs. 1 and 4 (sec. IV-A, V-D); other tasks get the curves of score and
// length, and mazes the paths through them; all get curves of their training. One sentence for each task compares the
// runs with the paper.
//
// Reads what run_folder.hpp writes: settings, command and seconds.csv (older folders have none), progress.csv,
// episodes.csv (without the file `finished` these logs may be missing or incomplete); of mazes paths.csv, if it is
// there; of finished grid worlds policy.csv and start_actions.csv.
// Promises: every number comes from these files or is marked as the paper's; equal folders give equal bytes; runs are
// averaged only if all their settings but the seed are equal, those of the data and the first weights included, and
// other runs stand in rows of their own, whose labels name what differs; errors name file and line.
// Leaves out: networks, statistics beyond mean and standard deviation, judging whether a difference matters.
// Order: logs; one run folder; numbers; the paper's results; figures; tables; sections; the report.
#pragma once

#include "console.hpp"
#include "figures.hpp"
#include "settings.hpp"

// ---------------------------------------------------------------------------------------------------------------------
// Logs

namespace results {  // the training program has names of its own: Run, Log, ...

constexpr double none = NAN;

// Comma-separated values: one header line, every line ended by a line feed, no quotes. Errors name `path` and the line.
struct Log {
    std::string path;
    Table table = {};

    // Errors: csv.unfinished, csv.fields.
    Log(const std::string& file, const std::string& text) : path(file) {
        const std::vector<std::string> lines = split(text, '\n');  // what follows the last line feed is the last part
        if (lines.size() < 2 || !lines.back().empty())
            fail("csv.unfinished", "%s: line %zu does not end; the file was cut off or is still being written",
                 path.c_str(), lines.size());
        table.header = split(lines[0], ',');
        for (size_t i = 1; i + 1 < lines.size(); ++i) {
            const std::vector<std::string>& row = table.rows.emplace_back(split(lines[i], ','));
            if (row.size() != table.header.size())
                fail("csv.fields", "%s: line %zu has %zu fields, the header has %zu", path.c_str(), i + 1, row.size(),
                     table.header.size());
        }
    }
    explicit Log(const std::string& file) : Log(file, read_file(file)) {}

    // One column from top to bottom. Errors: csv.column.
    std::vector<std::string> texts(const char* column) const {
        const auto found = std::ranges::find(table.header, column);
        if (found == table.header.end()) fail("csv.column", "%s: line 1 has no column \"%s\"", path.c_str(), column);
        std::vector<std::string> out;
        for (const auto& row : table.rows) out.push_back(row[found - table.header.begin()]);
        return out;
    }

    // A column of numbers from `low` to `high`. Errors: csv.number.
    std::vector<double> numbers(const char* column, double low, double high, bool may_be_nan = false) const {
        std::vector<double> out;
        for (const std::string& field : texts(column)) {
            out.push_back(to_number(field).value_or(none));
            const bool missing = may_be_nan && (field.ends_with("nan") || field.ends_with("inf"));
            if (!missing && !(out.back() >= low && out.back() <= high))
                fail("csv.number", "%s: line %zu: column \"%s\" holds \"%s\", expected a number from %g to %g",
                     path.c_str(), out.size() + 1, column, field.c_str(), low, high);
        }
        return out;
    }

    // A column of results; NaN where there is none.
    std::vector<double> results(const char* column, double most = 1e12) const {
        return numbers(column, -most, most, true);
    }

    // A column of counts, which must not fall. Errors: csv.number, csv.order.
    std::vector<double> counts(const char* column) const {
        const std::vector<double> out = numbers(column, 0, 1e12);
        const auto falls = std::is_sorted_until(out.begin(), out.end());
        if (falls != out.end())
            fail("csv.order", "%s: line %td: column \"%s\" falls to %.0f", path.c_str(), falls - out.begin() + 2,
                 column, *falls);
        return out;
    }

    // A column must hold expected_text(i) for i from 0 to count - 1, from top to bottom. Errors: csv.rows.
    void check_column(const char* column, int count, auto&& expected_text) const {
        std::vector<std::string> expected;
        for (int i = 0; i < count; ++i) expected.push_back(expected_text(i));
        const std::vector<std::string> got = texts(column);
        const auto differs = std::ranges::mismatch(got, expected).in1 - got.begin();
        if (got != expected)
            fail("csv.rows", "%s: line %td: column \"%s\" does not name the %d cells or moves in their order",
                 path.c_str(), differs + 2, column, count);
    }
};

// ---------------------------------------------------------------------------------------------------------------------
// One run folder

// How a method is shown; start_figure: the paper's figure of the actions at S.
struct Method {
    const char *name, *label, *colour, *start_figure;
};
constexpr std::array<Method, 3> methods{{
    {"dt", "DT", svg::green, ""},
    {"odt", "ODT", svg::blue, "1d"},
    {"wodtem", "WODTEM", svg::vermillion, "4b"},
}};

// One number in [0, 1] for each move, in the order of grid_move_table.
using MoveShares = std::array<double, grid_moves>;

struct MazeEpisode {
    double goal_x, goal_y;           // m, as observed
    bool reached;                    // some state lies within goal_radius of the goal
    std::vector<svg::Place> places;  // of each state, on the map or outside of it
};

// The settings that decide what a run computes, in the order of their table.
using Identity = std::vector<std::variant<bool, int64_t, double, std::string>>;

struct Run {
    std::string folder, command;
    Settings settings, usual;  // usual: what task, method and preset make them
    Identity identity;
    size_t method = 0;                   // in `methods`
    const MujocoTask* mujoco = nullptr;  // null: the grid world, or own data
    bool finished = false;
    double so_far = 0;                                    // online interactions
    std::map<std::string, std::vector<double>> progress;  // counts and result_columns of progress.csv
    std::vector<double> episode_length, episode_return;   // of each online episode
    std::vector<MoveShares> policy;                       // [36], or empty
    std::array<std::vector<double>, 3> start_actions;     // learned, D_offline, D_online: [8] each, or empty
    std::vector<MazeEpisode> paths;                       // of the latest evaluation in a maze, or empty
    std::vector<std::string> time;                        // cells of time_table(), or empty
    std::string time_error;                               // why they are dashes, or empty
    std::vector<std::string> files;                       // those to look at

    const Method& about_method() const { return methods[method]; }
    bool offline_only() const { return method == 0; }
    bool own() const { return settings.task == own_data; }
    // Empty if the run's program did not log it.
    std::vector<double> column(const std::string& name) const {
        const auto found = progress.find(name);
        return found == progress.end() ? std::vector<double>{} : found->second;
    }
};
using Runs = std::vector<const Run*>;                          // of one row unless said otherwise, by seed; never empty
using Quantity = std::string;                                  // a column of progress.csv
using Summary = double (*)(const Run&, const Quantity& name);  // final_value or last_ten

// The columns of results that are read. Every program wrote the first three. The first six are written as numbers, and
// so are bounded; the others are only drawn, as far as they can be.
constexpr std::array result_columns{
    "eval_length",   "eval_return",    "eval_score",        "advice",        "advice_distance",
    "advice_shift",  "loss",           "entropy",           "lambda",        "short",
    "gradient_norm", "rollout_return", "held_out_log_prob", "held_out_error"};  // squared_error: see read_run()

// policy.csv: 36 rows, one for each cell, with a column for each move. Errors: csv.rows, csv.number.
inline std::vector<MoveShares> read_policy(const Log& log) {
    log.check_column("row", grid_cells, [](int cell) { return std::to_string(cell / grid_size); });
    log.check_column("column", grid_cells, [](int cell) { return std::to_string(cell % grid_size); });
    std::vector<MoveShares> out(grid_cells);
    for (int move = 0; move < grid_moves; ++move) {
        const std::vector<double> shares = log.numbers(grid_move_table[move].name, 0, 1);
        for (int cell = 0; cell < grid_cells; ++cell) out[cell][move] = shares[cell];
    }
    return out;
}

// start_actions.csv: one row for each move; D_online is NaN without an online phase. Errors: csv.rows, csv.number.
inline std::array<std::vector<double>, 3> read_start_actions(const Log& log) {
    log.check_column("move", grid_moves, [](int move) { return grid_move_table[move].name; });
    return {log.numbers("learned", 0, 1), log.numbers("offline", 0, 1), log.numbers("online", 0, 1, true)};
}

// paths.csv: episodes count from 0, and in each of them its steps; an episode keeps its goal.
// Errors: csv.order, csv.number.
inline std::vector<MazeEpisode> read_paths(const MujocoTask& task, const Log& log) {
    const std::vector<double> episode = log.numbers("episode", 0, 1e9), x = log.numbers("x", -1e3, 1e3);
    const std::vector<double> step = log.numbers("step", 0, task.max_episode_steps), y = log.numbers("y", -1e3, 1e3);
    const std::vector<double> goal_x = log.numbers("goal_x", -1e3, 1e3), goal_y = log.numbers("goal_y", -1e3, 1e3);
    std::vector<MazeEpisode> out;
    for (size_t i = 0; i < step.size(); ++i) {
        if (step[i] == 0) out.push_back({goal_x[i], goal_y[i], false, {}});
        if (out.empty() || episode[i] != static_cast<double>(out.size() - 1) ||
            step[i] != static_cast<double>(out.back().places.size()) || goal_x[i] != out.back().goal_x ||
            goal_y[i] != out.back().goal_y)
            fail("csv.order",
                 "%s: line %zu: episode %g, step %g does not follow from the line before; both count up from 0, and an "
                 "episode keeps its goal",
                 log.path.c_str(), i + 2, episode[i], step[i]);
        MazeEpisode& latest = out.back();
        const auto [row, column] = maze_place(task, x[i], y[i]);
        latest.places.push_back({row, column});
        latest.reached = latest.reached || std::hypot(x[i] - goal_x[i], y[i] - goal_y[i]) <= goal_radius;
    }
    return out;
}

// seconds.csv in cells of time_table(), the first left empty: the last row's date, the duration, updates a second, and
// where the run was made. Where seconds do not rise another process went on. Errors: csv.order, csv.number.
inline std::vector<std::string> read_seconds(const Log& log) {
    const std::vector<double> updates = log.numbers("updates", 0, 1e12), seconds = log.counts("seconds");
    if (seconds.empty()) return {};
    double made = 0;
    for (size_t i = 1; i < seconds.size(); ++i)
        if (seconds[i] > seconds[i - 1]) made += updates[i] - updates[i - 1];
    const double elapsed = seconds.back() - seconds.front(), rate = elapsed > 0 ? made / elapsed : none;
    const auto last = [&](const char* column) { return log.texts(column).back(); };
    return {"", last("date"), clock_text(elapsed), svg::grouped(rate, 0), last("machine"), last("program")};
}

// A row averages over seeds. A data set is known by its checksum, whatever its file is called.
inline bool identifies(const SettingRow& row) {
    return row.field != Field(&Settings::seed) && row.field != Field(&Settings::dataset);
}

inline Identity identity_of(const Settings& settings) {
    Identity out;
    for (const SettingRow& row : setting_rows)
        if (identifies(row)) std::visit([&](auto field) { out.emplace_back(settings.*field); }, row.field);
    return out;
}

// The folder itself if it is a run's, else the run folders up to `levels` below it, in any order: --methods and --seeds
// make METHOD/seed-N in --out. What is no folder has none. Errors: report.folder.
inline std::vector<std::string> run_folders(const std::string& folder, int levels = 3) {
    if (is_there(folder + "/settings")) return {folder};
    std::vector<std::string> found;
    std::error_code error;
    if (levels == 3 || (levels > 0 && !std::filesystem::is_symlink(folder, error)))  // a link may lead in a circle
        for (const auto& entry : std::filesystem::directory_iterator(folder, error))
            for (const std::string& run : run_folders(entry.path(), levels - 1)) found.push_back(run);
    if (found.empty() && levels == 3)
        fail("report.folder",
             "%s: is no run folder and has none up to three levels below it: nowhere there is a file `settings`, which "
             "training writes first",
             folder.c_str());
    return found;
}

// All files of one run folder. Errors: report.setting, and those of settings_from_text() and Log.
inline Run read_run(const std::string& folder) {
    const auto file = [&](const char* name) { return folder + "/" + name; };
    const auto exists = [&](const char* name) { return is_there(file(name)); };
    Run run;
    run.folder = folder;
    run.settings = settings_from_text(read_file(file("settings")), file("settings"));
    run.usual = default_settings(run.settings.task, run.settings.method, run.settings.preset);
    for (const SettingRow& row : setting_rows)  // what own data decide is usual for them, but which data they are
        if (run.own() && source_of(run.settings, row) != "command line" &&
            row.field != Field(&Settings::dataset_sha256))
            set_setting(run.usual, row.name, setting_text(run.settings, row));
    run.command = exists("command") ? read_file(file("command")) : train_command(run.settings);
    if (run.command.ends_with('\n')) run.command.pop_back();
    run.command = svg::visible(run.command, "'$'", "''");  // what it quotes is quoted again, as bash reads it
    run.identity = identity_of(run.settings);
    while (run.settings.method != methods[run.method].name) ++run.method;  // the settings hold none but these
    run.mujoco = find_mujoco_task(run.settings.task);
    if (run.mujoco && run.settings.physics == "none")
        fail("report.setting", "%s: %s cannot have physics none", file("settings").c_str(), run.settings.task.c_str());
    run.finished = exists("finished");
    for (const char* name : {"settings", "command", "progress.csv", "episodes.csv", "seconds.csv"})
        if (exists(name)) run.files.emplace_back(name);
    try {
        if (exists("seconds.csv")) run.time = read_seconds(Log(file("seconds.csv")));
    } catch (const Error& error) {  // no result depends on it
        run.time = {"", "-", "-", "-", "-", "-"};
        run.time_error = error.what();
    }
    if (run.finished || exists("progress.csv")) {  // a run that has just begun may not have its logs yet
        const Log log(file("progress.csv"));
        run.progress["interactions"] = log.counts("interactions");
        if (contains(log.table.header, "updates")) run.progress["updates"] = log.counts("updates");
        for (size_t i = 0; i < result_columns.size(); ++i)
            if (i < 3 || contains(log.table.header, result_columns[i]))
                run.progress[result_columns[i]] = log.results(result_columns[i], i < 6 ? 1e12 : 1e300);
        if (!log.table.rows.empty()) run.so_far = run.progress["interactions"].back();
    }
    if (run.own() && run.offline_only() && run.settings.moves == 0) {  // its loss is a squared error, no likelihood
        run.progress["squared_error"] = run.column("loss");
        for (const char* likelihood : {"loss", "held_out_log_prob"}) run.progress.erase(likelihood);
    }
    if (!run.offline_only() && (run.finished || exists("episodes.csv"))) {
        const Log log(file("episodes.csv"));
        run.episode_length = log.numbers("length", 1, run.mujoco ? 1e9 : grid_max_steps);
        run.episode_return = log.results("return");
        const std::vector<double> at = log.counts("interactions");
        if (!at.empty()) run.so_far = std::max(run.so_far, at.back());
    }
    if (run.mujoco && run.mujoco->maze && exists("paths.csv"))
        run.paths = read_paths(*run.mujoco, Log(file("paths.csv")));
    if (run.mujoco || run.own() || !run.finished) return run;
    run.policy = read_policy(Log(file("policy.csv")));
    if (!run.offline_only()) run.start_actions = read_start_actions(Log(file("start_actions.csv")));
    return run;
}

// ---------------------------------------------------------------------------------------------------------------------
// From runs to numbers. NaN: there is none.

// "5.00 ± 0.00"; "5.00 ± -" for one value; "-" for none.
inline std::string plus_minus(const Moments& results, int decimals = 2) {
    if (results.count == 0) return "-";
    return svg::grouped(results.mean(), decimals) + " ± " + svg::grouped(results.sample_deviation(), decimals);
}

// The value of the last evaluation that has one.
inline double final_value(const Run& run, const Quantity& quantity) {
    double out = none;
    for (const double value : run.column(quantity))
        if (!std::isnan(value)) out = value;
    return out;
}

// Mean over the last ten evaluations (or all, if there are fewer): one evaluation of a policy that wavers says little.
inline double last_ten(const Run& run, const Quantity& quantity) {
    std::vector<double> values = run.column(quantity);
    std::erase_if(values, [](double value) { return std::isnan(value); });
    values.erase(values.begin(), values.end() - static_cast<int>(std::min<size_t>(values.size(), 10)));
    return moments_of(values).mean();
}

inline Moments over_seeds(const Runs& runs, Summary summary, const Quantity& quantity) {
    std::vector<double> values;
    for (const Run* run : runs) values.push_back(summary(*run, quantity));
    return moments_of(values);
}

// The interactions of the first evaluation from which on every one had this length.
inline double kept_from(const Run& run, double length) {
    const std::vector<double> lengths = run.column("eval_length"), at = run.column("interactions");
    double from = none;
    for (size_t i = 0; i < lengths.size(); ++i) from = lengths[i] != length ? none : std::isnan(from) ? at[i] : from;
    return from;
}

// The shortest online episode that reached the goal.
inline double shortest_met(const Run& run) {
    double out = none;
    for (size_t i = 0; i < run.episode_length.size(); ++i)
        if (run.episode_return[i] == 1) out = std::fmin(out, run.episode_length[i]);  // fmin ignores NaN
    return out;
}

// The last length of each bar of the histogram, and its label; less than 5 occurs only on a torus.
constexpr std::array<int, 12> last_of_bar{5, 6, 7, 8, 9, 10, 15, 20, 30, 50, 99, 100};
constexpr std::array<const char*, 12> bar_labels{"≤ 5",   "6",     "7",     "8",     "9",     "10",
                                                 "11–15", "16–20", "21–30", "31–50", "51–99", "100"};

// How many of the lengths belong to each bar.
inline std::vector<double> count_lengths(const std::vector<double>& lengths) {
    std::vector<double> out(last_of_bar.size(), 0);
    for (const double length : lengths)
        out[std::lower_bound(last_of_bar.begin(), last_of_bar.end() - 1, length) - last_of_bar.begin()] += 1;
    return out;
}

// The index of the most likely move; of equally likely ones the first.
inline int most_likely(const MoveShares& shares) {
    return static_cast<int>(std::max_element(shares.begin(), shares.end()) - shares.begin());
}

// Cells from S on by the most likely moves, up to G or to the last before a cell would come again.
inline std::vector<int> greedy_path(const std::vector<MoveShares>& policy, EdgeRule edge) {
    std::vector<int> path{grid_start};
    while (path.back() != grid_goal) {
        const int next = next_cell(edge, path.back(), most_likely(policy[path.back()]));
        if (std::find(path.begin(), path.end(), next) != path.end()) break;
        path.push_back(next);
    }
    return path;
}

// ---------------------------------------------------------------------------------------------------------------------
// The paper's results

// `deviation`: half the range of our means that agree with the paper's; in Table III the standard deviation.
struct PaperResult {
    double mean, deviation;
    const char* words = "";  // of a result that the paper does not give as mean ± deviation

    std::string text() const {
        return *words != 0 ? words : svg::grouped(mean, 2) + " ± " + svg::grouped(deviation, 2);
    }
};
struct PaperRow {
    const char* task;  // without the version
    std::array<PaperResult, 3> by_method;
};
// WODTEM Table III: normalised scores after 200,000 online interactions, over five seeds; DT, ODT, WODTEM. The last row
// has the grid world's final lengths.
constexpr std::array<PaperRow, 14> paper_results{{
    {"hopper-medium", {{{61.03, 5.11}, {95.56, 3.53}, {96.54, 4.60}}}},
    {"hopper-medium-replay", {{{62.75, 15.05}, {85.52, 3.26}, {88.78, 2.16}}}},
    {"walker2d-medium", {{{72.03, 4.32}, {72.58, 1.42}, {73.99, 2.26}}}},
    {"walker2d-medium-replay", {{{42.53, 15.36}, {73.11, 4.54}, {76.26, 3.97}}}},
    {"halfcheetah-medium", {{{42.43, 0.30}, {42.38, 0.25}, {42.17, 0.11}}}},
    {"halfcheetah-medium-replay", {{{35.92, 1.56}, {40.08, 0.46}, {40.09, 0.51}}}},
    {"ant-medium", {{{93.56, 4.94}, {87.51, 2.69}, {88.96, 2.45}}}},
    {"ant-medium-replay", {{{89.08, 5.33}, {88.92, 1.10}, {91.31, 2.25}}}},
    {"antmaze-umaze", {{{53.30, 5.52}, {82.60, 5.57}, {80.20, 1.33}}}},
    {"antmaze-umaze-diverse", {{{52.50, 9.89}, {53.60, 1.47}, {58.60, 3.72}}}},
    {"maze2d-umaze", {{{39.95, 12.17}, {31.85, 7.46}, {75.18, 10.79}}}},
    {"maze2d-medium", {{{19.11, 4.17}, {82.88, 7.88}, {96.23, 3.24}}}},
    {"maze2d-large", {{{38.93, 4.32}, {69.23, 12.35}, {84.26, 16.54}}}},
    {"gridworld", {{{none, none, "no number (fig. 4a)"}, {7, 0.5, "about 7 (sec. IV-A)"}, {5, 0, "5 (sec. V-D)"}}}},
}};

// The paper's result for a run's task and method, or null.
inline const PaperResult* paper_result(const Run& run) {
    const std::string& task = run.settings.task;
    for (const PaperRow& row : paper_results)
        if (task == row.task || task.starts_with(std::string(row.task) + "-v")) return &row.by_method[run.method];
    return nullptr;
}

// ---------------------------------------------------------------------------------------------------------------------
// Figures of one group of runs

// The colours of ten paths: Okabe and Ito's but black, three of Tol's that stand apart from them, grey. More paths
// would hide each other. The first three are the methods', and the others those of further rows of a method.
constexpr std::array<const char*, 10> palette{svg::blue, svg::vermillion, svg::green, svg::purple, "#E69F00",
                                              svg::sky,  "#332288",       "#882255",  "#999933",   "#777777"};

// Runs that differ in the seed alone.
struct Row {
    Runs runs;
    size_t number;       // among the rows of its method, from 0
    const char* colour;  // the first row of a method has the method's
    std::string differences = "";

    const Run& any() const { return *runs[0]; }
    std::string label() const {
        return any().about_method().label + (differences.empty() ? "" : " (" + differences + ")");
    }
    std::string name_of(const Run& run) const { return label() + " seed " + std::to_string(run.settings.seed); }
    std::string file() const {  // a part of its figures' names
        return any().settings.method + (number == 0 ? "" : "-" + std::to_string(number + 1));
    }
};

// Runs of one task, preset and physics.
struct Group {
    Runs runs;                           // by method, then by the other settings, then by seed
    std::string task, conditions, file;  // conditions: preset and physics; file: the beginning of the figures' names
    Quantity quantity;                   // which is compared with the paper; of own data the action error
    std::string unit;                    // its name
    int decimals;                        // of its values
    std::vector<Row> rows = {};          // in the order of the runs
    Table in_all = {{"Other than the preset, in all of these runs"}, {}};

    const Run& any() const { return *runs[0]; }
    std::string heading() const { return task + ", " + conditions; }
};

// The rows of a group's runs. Errors: report.same_seed.
inline std::vector<Row> rows_of(const Runs& runs) {
    std::vector<Row> rows;
    size_t further = 0;  // rows that are not the first of their method
    for (const Run* run : runs) {
        if (rows.empty() || rows.back().any().identity != run->identity) {
            const bool first = rows.empty() || rows.back().any().method != run->method;
            const char* const colour = first ? run->about_method().colour
                                             : palette[methods.size() + further++ % (palette.size() - methods.size())];
            rows.push_back({{}, first ? 0 : rows.back().number + 1, colour});
        } else if (rows.back().runs.back()->settings.seed == run->settings.seed) {
            fail("report.same_seed", "%s and %s have the same settings and the same seed; give only one of them",
                 rows.back().runs.back()->folder.c_str(), run->folder.c_str());
        }
        rows.back().runs.push_back(run);
    }
    return rows;
}

// A setting and its value for readers: of checksums the first digits, of the data set also the file's name.
inline std::string shown_setting(const Settings& settings, const SettingRow& row) {
    constexpr size_t digits = 8;
    if (row.field == Field(&Settings::dataset_sha256))
        return "dataset=" + settings.dataset +
               (settings.dataset == "none" ? "" : " (SHA-256 " + settings.dataset_sha256.substr(0, digits) + ")");
    const std::string value = setting_text(settings, row);
    return std::string(row.name) + "=" +
           (row.field == Field(&Settings::first_weights) ? value.substr(0, digits) : value);
}

// Compares each setting with what task, method and preset make it. A difference that all rows share goes to `in_all`.
// Any other goes into the labels of all rows of the methods that it occurs in, those without it included, so that no
// value is left to guess. What sets methods apart by their presets is not named.
inline void name_differences(Group& group) {
    for (const SettingRow& setting : setting_rows) {
        if (!identifies(setting)) continue;
        std::map<std::string, std::string> departures;  // of the rows: how each value is shown; "": none
        std::set<size_t> methods_that_depart;
        for (const Row& row : group.rows) {
            const Run& run = row.any();
            const std::string value = setting_text(run.settings, setting);
            const bool departs = value != setting_text(run.usual, setting);
            departures.try_emplace(departs ? value : "", departs ? shown_setting(run.settings, setting) : "");
            if (departs) methods_that_depart.insert(run.method);
        }
        if (departures.size() == 1) {
            if (const std::string& shown = departures.begin()->second; !shown.empty())
                group.in_all.rows.push_back({shown});
            continue;
        }
        for (Row& row : group.rows)
            if (methods_that_depart.contains(row.any().method))
                row.differences += (row.differences.empty() ? "" : ", ") + shown_setting(row.any().settings, setting);
    }
}

// Adds a chart, if there is something to draw. Below its title stand the conditions, how many seeds its series are
// from, and what `spread` shows of them; file: the end of its name.
inline void add_chart(std::vector<Part>& parts, const Group& group, svg::Chart chart, const std::string& spread,
                      const std::string& caption, const std::string& file) {
    std::set<size_t> seeds;
    for (const svg::Series& series : svg::drawn_series(chart)) seeds.insert(series.lines.size());
    if (seeds.empty()) return;
    const size_t least = *seeds.begin(), most = *seeds.rbegin();
    chart.subtitle = group.conditions + "; n = 1 seed";
    if (most > 1)
        chart.subtitle = group.conditions + "; mean over n = " + (least < most ? std::to_string(least) + " to " : "") +
                         std::to_string(most) + " seeds; " + spread;
    parts.emplace_back(Figure{svg::draw_chart(chart), caption, group.file + "-" + file + ".svg"});
}
inline std::string subtitle_of_one(const Group& group, const Row& row) {
    return group.conditions + "; one run, of n = " + std::to_string(row.runs.size()) +
           (row.runs.size() > 1 ? " seeds" : " seed");
}

// Charts of a column of progress.csv over another one, which never falls; file: the end of the name.
struct Curve {
    const char *y, *x, *title, *unit, *file, *caption;
    bool cuts_outliers = false;  // a first mean from before the network learned would flatten all others
};
constexpr Curve curves[] = {
    {"eval_score", "interactions", "evaluation score", "normalised score", "score", "Mean score of an evaluation."},
    {"eval_score", "updates", "evaluation score", "normalised score", "score-updates", "The same over updates."},
    {"eval_length", "interactions", "evaluation length", "steps", "length", "Mean length of an evaluation's episodes."},
    {"eval_length", "updates", "evaluation length", "steps", "length-updates", "The same over updates."},
    {"rollout_return", "interactions", "return of online episodes", "return", "rollouts",
     "Mean over the episodes since the point before."},
    {"rollout_return", "updates", "return of online episodes", "return", "rollouts-updates", "The same over updates."},
    {"held_out_error", "updates", "action error, held out", "error", "held-out-error",
     "The share of moves that are not the policy's most likely one, or the squared error of its mean.", true},
    {"held_out_log_prob", "updates", "log-probability, held out", "log pi(a | s, g) of a step", "held-out",
     "Mean over the steps of the trajectories that are held out.", true},
    {"loss", "updates", "loss", "L, eq. (9)", "loss",
     "Mean over the updates since the point before, as in the other figures over updates but that of lambda.", true},
    {"squared_error", "updates", "loss of DT", "squared error", "dt-loss",
     "Mean over the updates since the point before.", true},
    {"entropy", "updates", "entropy", "H-bar, eq. (10)", "entropy", "Of the policy, on the batches of the updates."},
    {"lambda", "updates", "lambda", "lambda, eq. (8)", "lambda", "The multiplier of the entropy constraint."},
    {"gradient_norm", "updates", "gradient", "norm of the gradient", "gradient", "Before it is clipped.", true},
    {"short", "updates", "steps that fall short", "share of the steps", "short",
     "Of the steps in the batches, those with d < e-hat: eq. (7) gives them the weight alpha."},
};

// The paper's results are marked beside the curves of the quantity that it gives. DT has a single point: as an
// evaluation it is a level, elsewhere it is left out.
inline svg::Chart chart_of(const Group& group, const Curve& curve) {
    const std::string over = curve.x == std::string("updates") ? "updates" : "online interactions";
    svg::Chart chart{group.task + ": " + curve.title + " over " + over, "", over, curve.unit};
    chart.cuts_outliers = curve.cuts_outliers;
    for (const Row& row : group.rows) {
        const bool level = row.any().offline_only() && !row.any().own();
        if (level && !std::string(curve.y).starts_with("eval_")) continue;
        svg::Series& series = chart.series.emplace_back(row.label(), row.colour, std::vector<svg::Line>{}, level);
        for (const Run* run : row.runs) {
            const std::vector<double> x = run->column(curve.x), y = run->column(curve.y);
            svg::Line& line = series.lines.emplace_back();
            for (size_t i = 0; i < std::min(x.size(), y.size()); ++i) line.push_back({x[i], y[i]});
        }
        const PaperResult* paper = paper_result(row.any());
        if (paper && row.number == 0 && curve.y == group.quantity)
            chart.marks.push_back({std::string("paper: ") + row.any().about_method().label,
                                   row.any().about_method().colour, paper->mean});
    }
    return chart;
}

// The curves whose column `wanted` accepts.
inline void add_curves(std::vector<Part>& parts, const Group& group, const auto& wanted) {
    for (const Curve& curve : curves) {
        if (!wanted(std::string_view(curve.y))) continue;
        add_chart(parts, group, chart_of(group, curve), "thin lines: each seed", curve.caption, curve.file);
        const bool twice =
            std::ranges::count(curves, curve.y, [](const Curve& c) { return std::string_view(c.y); }) > 1;
        if (twice || group.any().own()) continue;
        Curve again = curve;
        again.x = "interactions";
        add_chart(parts, group, chart_of(group, again), "thin lines: each seed", "The same over interactions.",
                  std::string(curve.file) + "-interactions");
    }
}

// Bars of a row's runs; heights(run): of each category, or none.
inline svg::Series bars_of(const std::string& label, const char* colour, const Runs& runs, const auto& heights) {
    svg::Series out{label, colour, {}};
    for (const Run* run : runs) {
        svg::Line& line = out.lines.emplace_back();
        for (const double height : heights(*run)) line.push_back({static_cast<double>(line.size()), height});
    }
    return out;
}
constexpr const char* stroke_meaning = "stroke: lowest to highest seed";

// Fig. 1c, of the runs that have online episodes.
inline void add_histogram(std::vector<Part>& parts, const Group& group) {
    svg::Chart chart{group.task + ": lengths of the online episodes", "", "episode length, steps", "episodes per seed"};
    chart.categories.assign(bar_labels.begin(), bar_labels.end());
    const auto counts = [](const Run& run) {
        return run.episode_length.empty() ? std::vector<double>{} : count_lengths(run.episode_length);
    };
    for (const Row& row : group.rows) chart.series.push_back(bars_of(row.label(), row.colour, row.runs, counts));
    add_chart(parts, group, chart, stroke_meaning,
              "Compare with fig. 1c of the paper. How many of the episodes met in online training had which length; "
              "from 11 on a bar covers a range of lengths, and 100 is the time limit.",
              "episodes");
}

// Figs. 1d, 4b, of finished runs. All such figures of a group have one scale.
inline void add_start_actions(std::vector<Part>& parts, const Group& group, const Row& row) {
    const Method& method = row.any().about_method();
    svg::Chart chart{group.task + ": actions at S, " + row.label(), "", "move", "share"};
    for (const Run* run : group.runs)
        for (const std::vector<double>& shares : run->start_actions)
            chart.covers.insert(chart.covers.end(), shares.begin(), shares.end());
    for (const GridMove& move : grid_move_table) chart.categories.emplace_back(move.name);
    const std::array<std::pair<const char*, const char*>, 3> shown{
        {{"learned policy", method.colour}, {"D_offline", svg::sky}, {"D_online", svg::purple}}};
    for (size_t k = 0; k < shown.size(); ++k)
        chart.series.push_back(
            bars_of(shown[k].first, shown[k].second, row.runs, [&](const Run& run) { return run.start_actions[k]; }));
    add_chart(parts, group, chart, stroke_meaning,
              std::string("Compare with fig. ") + method.start_figure +
                  " of the paper. Finished runs. Share of each move at the start cell S: its probability under the "
                  "learned policy, and its frequency in D_offline and, at the end, in D_online. R, D, L, U: right, "
                  "down, left, up.",
              "start-" + row.file());
}

// Fig. 1a shows the shortest path in this way; the paper does not show a learned one.
inline Figure policy_map(const Group& group, const Row& row) {
    const Run& run = row.any();
    const char* const path_colour = "#B9DAEF";
    const auto place = [](int cell) { return svg::Place(cell / grid_size, cell % grid_size); };
    svg::CellMap map{group.task + ": learned policy of " + row.name_of(run), grid_size, grid_size};
    map.subtitle = subtitle_of_one(group, row);
    const std::vector<int> path = greedy_path(run.policy, make_grid_world(run.settings).edge);
    for (const int cell : path) map.fill_cell(place(cell), path_colour);
    for (int cell = 0; cell < grid_goal; ++cell) {  // no move is made at the goal, which is the last cell
        const int move = most_likely(run.policy[cell]);
        const auto& [name, drow, dcolumn] = grid_move_table[move];
        map.add_arrow(place(cell), drow, dcolumn, run.policy[cell][move]);
    }
    map.add_letter(place(grid_start), "S", svg::black);
    map.add_letter(place(grid_goal), "G", svg::vermillion);
    map.keys = {{svg::rectangle(5, -8, 16, 16, svg::fill(path_colour)), "path from S"}};
    for (const double p : {0.25, 0.5, 1.0})
        map.keys.push_back({svg::arrow_mark(13, 0, 0, 1, p, 40), "p = " + svg::number(p)});
    const std::string caption =
        "Compare the blue cells with fig. 1a of the paper. Arrows: the most likely move in each cell, with its "
        "probability p. These moves " +
        std::string(path.back() == grid_goal ? "reach G" : "do not reach G, but return to a visited cell") +
        ". Moves: " + std::to_string(path.size() - 1) + ". Moves off the grid: " + run.settings.edge + ".";
    return {svg::draw_map(map), caption, group.file + "-grid-" + row.file() + ".svg"};
}

// The map of a maze without paths; `map`: rows from the top, each ended by a slash; 1: wall, all else is free.
inline svg::CellMap maze_cells(const std::string& title, const char* map) {
    const std::vector<MazeCell> walls = cells_marked(map, '1');  // which surround the map: the last is its corner
    svg::CellMap out{title, walls.back().row + 1, walls.back().column + 1};
    for (const auto& [row, column] : walls) out.fill_cell(svg::Place(row, column), "#C8C8C8");
    out.keys = {{svg::start_mark(13, 0, svg::faint_ink), "start"},
                {svg::end_mark(13, 0, svg::faint_ink), "end"},
                {svg::circle(13, 0, 8, svg::stroke(svg::faint_ink, 1.5)), "goal (radius 0.5 m)"}};
    return out;
}

// The latest evaluation of one run, in a maze. An ant's episodes have goals of their own, maze2d's share one.
inline Figure maze_map(const Group& group, const Row& row, const Run& run) {
    const MujocoTask& task = *run.mujoco;
    const bool ant = task.rules == Rules::antmaze;
    svg::CellMap map = maze_cells(group.task + ": paths of " + row.name_of(run), task.maze);
    map.subtitle = subtitle_of_one(group, row);
    const double radius = goal_radius / maze_cell_length(task);
    size_t reached = 0;
    for (size_t i = 0; i < run.paths.size(); ++i) {
        const MazeEpisode& episode = run.paths[i];
        reached += episode.reached;
        if (i >= palette.size()) continue;
        const auto [goal_row, goal_column] = maze_place(task, episode.goal_x, episode.goal_y);
        if (ant || i == 0) map.add_circle({goal_row, goal_column}, radius, ant ? palette[i] : svg::ink);
        map.add_path(episode.places, palette[i]);
    }
    const std::string caption =
        "The latest evaluation of " + row.name_of(run) + (run.finished ? "" : ", unfinished") + ": " +
        std::to_string(reached) + " of " + std::to_string(run.paths.size()) +
        " episodes came within 0.5 m of the goal" +
        (ant ? ", which ended them; each has a goal of its own, circled in its colour."
             : " at some time. None ends there: the score counts the steps within that distance.") +
        (run.paths.size() > palette.size() ? " The first 10 are drawn." : "") +
        " The maze as its map is printed, walls grey; x runs " +
        (ant ? "to the right and y downwards." : "downwards and y to the right.");
    return {svg::draw_map(map), caption, group.file + "-paths-" + row.file() + ".svg"};
}

// ---------------------------------------------------------------------------------------------------------------------
// Tables and sentences

inline long unfinished(const Runs& runs) { return std::ranges::count(runs, false, &Run::finished); }

// "WODTEM 5.50 ± 0.71, paper 5 (sec. V-D), ours is higher", or "ODT 0.1250" where the paper has no result; ours agrees
// if it differs by at most the paper's deviation.
inline std::string compared(const Row& row, const Group& group) {
    const Moments ours = over_seeds(row.runs, final_value, group.quantity);
    std::string out = row.label();
    if (unfinished(row.runs) > 0) out += " (unfinished)";
    if (ours.count == 0) out += " has no result yet";
    if (ours.count == 1) out += " " + svg::grouped(ours.mean(), group.decimals);
    if (ours.count > 1) out += " " + plus_minus(ours, group.decimals);
    const auto paper = paper_result(row.any());
    if (!paper) return out;
    const double difference = ours.mean() - paper->mean;
    out += ", paper " + paper->text();
    if (std::fabs(difference) <= paper->deviation) out += ", agrees";
    if (difference > paper->deviation) out += ", ours is higher";
    if (-difference > paper->deviation) out += ", ours is lower";
    return out;
}

// Compares each row with the paper in one sentence, WODTEM first. The sentence ends with what else differs from the
// paper's experiment, the number of interactions and the data set, or says that the paper has no result.
inline std::string verdict(const Group& group) {
    const Run& any = group.any();
    std::string out = group.heading() + ", final " + group.unit + ": ";
    for (const Row& row : std::views::reverse(group.rows))
        out += compared(row, group) + (&row == &group.rows[0] ? "" : "; ");
    if (!paper_result(any)) return out + "; the paper has no result on these data.";
    if (const double far = std::ranges::max(group.runs, {}, &Run::so_far)->so_far; far > 0)
        out +=
            "; online interactions: up to " + svg::grouped(far, 0) + ", paper " + (any.mujoco ? "200,000" : "20,000");
    const auto has_other_data = [](const Run* run) {
        return run->mujoco && run->settings.source.at("dataset") != "D4RL's published file";
    };
    if (std::ranges::any_of(group.runs, has_other_data)) out += "; the data set is not D4RL's file";
    return out + ".";
}

// One line for each row: the number of seeds, our results as mean ± deviation over them, and the paper's, if it has
// the task.
inline Table method_table(const Group& group) {
    const bool own = group.any().own(), scores = group.quantity == "eval_score";
    Table table{{"Method", "Seeds", "Final " + group.unit, "Mean of last 10"}, {}};
    for (const char* further : {"Paper", "Final return"})
        if (!own) table.header.emplace_back(further);
    if (scores) table.header.push_back("Final length");
    if (own) table.header.push_back("Final log-probability, held out");
    for (const Row& row : group.rows) {
        const auto mean = [&](Summary summary, const Quantity& quantity) {
            return plus_minus(over_seeds(row.runs, summary, quantity), group.decimals);
        };
        std::string seeds = std::to_string(row.runs.size());
        if (unfinished(row.runs) > 0) seeds += " (" + std::to_string(unfinished(row.runs)) + " unfinished)";
        const PaperResult* paper = paper_result(row.any());
        std::vector<std::string>& line = table.rows.emplace_back();
        line = {row.label(), seeds, mean(final_value, group.quantity), mean(last_ten, group.quantity)};
        if (!own) line.insert(line.end(), {paper ? paper->text() : "-", mean(final_value, "eval_return")});
        if (scores) line.push_back(mean(final_value, "eval_length"));
        if (own) line.push_back(plus_minus(over_seeds(row.runs, final_value, "held_out_log_prob")));
    }
    return table;
}

// What the memory changes of the loss, as progress.csv has it: mean of the last ten rows, in thousandths, over seeds.
inline Table dose_table(const Group& group) {
    Table table{{"The memory's dose, in thousandths", "Share of the loss", "Mean length of a shift",
                 "Length of the mean shift"},
                {}};
    for (const Row& row : group.rows) {
        const auto thousandths = [&](const Quantity& quantity) {
            const auto summary = [](const Run& run, const Quantity& what) { return 1000 * last_ten(run, what); };
            return plus_minus(over_seeds(row.runs, summary, quantity));
        };
        if (row.any().settings.method == "wodtem" && !row.any().column("advice").empty())
            table.rows.push_back(
                {row.label(), thousandths("advice"), thousandths("advice_distance"), thousandths("advice_shift")});
    }
    return table;
}

// One row for each run: how far it came, its own results, and where it lies.
inline Table run_table(const Group& group) {
    const bool own = group.any().own(), grid = !group.any().mujoco && !own;
    Table table{{"Run", "State", own ? "Updates" : "Interactions", "Final " + group.unit, "Last 10"}, {}};
    if (grid) table.header.insert(table.header.end(), {"Shortest met", "At 5 from"});
    table.header.push_back("Folder");
    for (const Row& row : group.rows)
        for (const Run* run : row.runs) {
            std::vector<std::string>& line = table.rows.emplace_back();
            line = {row.name_of(*run), run->finished ? "finished" : "unfinished",
                    svg::grouped(own ? final_value(*run, "updates") : run->so_far, 0)};
            for (const Summary summary : {final_value, last_ten})
                line.push_back(svg::grouped(summary(*run, group.quantity), group.decimals));
            if (grid)
                line.insert(line.end(), {svg::grouped(shortest_met(*run), 0), svg::grouped(kept_from(*run, 5), 0)});
            line.push_back(run->folder);
        }
    return table;
}

// When and where the runs were made, as far as they say.
inline Table time_table(const Group& group) {
    Table table{{"Run", "Last row (UTC)", "Duration", "Updates a second", "Machine", "Program"}, {}, true};
    for (const Row& row : group.rows)
        for (const Run* run : row.runs)
            if (!run->time.empty()) table.rows.emplace_back(run->time)[0] = row.name_of(*run);
    return table;
}

// Every setting that is not the same in all rows, those that the presets set apart included.
inline Table settings_table(const Group& group) {
    Table table{{"Settings that differ"}, {}, true};
    for (const Row& row : group.rows) table.header.push_back(row.label());
    for (const SettingRow& setting : setting_rows) {
        std::vector<std::string> cells{setting.name};
        for (const Row& row : group.rows) cells.push_back(setting_text(row.any().settings, setting));
        if (identifies(setting) && std::set(cells.begin() + 1, cells.end()).size() > 1) table.rows.push_back(cells);
    }
    return table;
}

// One line for each run, with the command that repeats it.
inline Table command_table(const Group& group) {
    Table table{{"To repeat these runs, each with an --out of its own", "Arithmetic"}, {}};
    for (const Run* run : group.runs) table.rows.push_back({run->command, run->settings.arithmetic});
    return table;
}

// ---------------------------------------------------------------------------------------------------------------------
// Sections, each of one group

// Tables and figures of the grid world, in the paper's order of figures.
inline void add_grid_world(std::vector<Part>& parts, const Group& group) {
    parts.emplace_back(
        "Lengths are in steps. Shortest met: the shortest online episode that reached the goal. At 5 from: the online "
        "interactions of the first evaluation from which on every one took 5 steps, the length of the shortest path "
        "(0: from the end of offline training on; \"-\": none). An episode ends at the goal or after 100 steps. "
        "Compare the first figure with figs. 1b and 4a of the paper.");
    add_curves(parts, group, [](auto column) { return column == "eval_length"; });
    for (const Row& row : group.rows) add_start_actions(parts, group, row);
    add_histogram(parts, group);
    for (Row row : group.rows) {
        std::erase_if(row.runs, [](const Run* run) { return !run->finished; });
        if (!row.runs.empty()) parts.emplace_back(policy_map(group, row));
    }
}

// Any other task: what its numbers rest on, curves, and in mazes one run's paths for each row.
inline void add_mujoco_task(std::vector<Part>& parts, const Group& group) {
    const Settings& settings = group.any().settings;
    const MujocoTask& task = *group.any().mujoco;
    const bool ends_early = task.rules != Rules::maze2d && task.rules != Rules::halfcheetah;
    const char* const bodies = settings.physics == "d4rl" ? "in MuJoCo up to 2.1.0, which made D4RL's data"
                                                          : "MuJoCo 2.2 computes them from the geometry";
    const char* const end = task.rules == Rules::antmaze ? "An episode ends at the goal, or after "
                            : ends_early ? "An episode ends when the body leaves gym's healthy range, or after "
                                         : "Every episode takes ";
    parts.emplace_back("Physics " + settings.physics + ": masses and inertias as " + bodies +
                       ". Normalised score, as D4RL defines it: linear in the return, 0 for a random policy (" +
                       svg::grouped(task.score_low, 2) + "), 100 for an expert (" + svg::grouped(task.score_high, 2) +
                       "). " + end + svg::grouped(task.max_episode_steps, 0) + " steps.");
    // Where no episode ends early, the length is a flat line.
    add_curves(parts, group,
               [&](auto column) { return column == "eval_score" || (ends_early && column == "eval_length"); });
    for (const Row& row : group.rows) {
        const auto found = std::ranges::find_if(row.runs, [](const Run* run) { return !run->paths.empty(); });
        if (found != row.runs.end()) parts.emplace_back(maze_map(group, row, **found));
    }
}

// Own data: the curves of what is held out follow with those of training.
inline void add_own_data(std::vector<Part>& parts, const Group&) {
    parts.emplace_back(
        "There is no environment: nothing is evaluated by acting. On the trajectories that are held out, how far the "
        "policy's actions are from theirs (the share of other moves, or the squared error, a mean over an action's "
        "numbers), and how likely it finds them, which a DT of continuous actions does not tell.");
}

// "Updates made, mean over seeds: ODT 42,000; WODTEM 143,000, 3.4 times those of ODT." and what follows from it.
// Nothing for own data, or where there is one row.
inline std::string updates_sentence(const Group& group) {
    if (group.any().own() || group.rows.size() < 2) return "";
    std::string out;
    const Row* first = nullptr;
    const auto updates = [](const Row& row) { return over_seeds(row.runs, final_value, "updates").mean(); };
    for (const Row& row : group.rows) {
        if (row.any().offline_only() || std::isnan(updates(row))) continue;
        out += (first ? "; " : "Updates made, mean over seeds: ") + row.label() + " " + svg::grouped(updates(row), 0);
        if (first) out += ", " + svg::grouped(updates(row) / updates(*first), 1) + " times those of " + first->label();
        if (!first) first = &row;
    }
    return out.empty() ? out
                       : out +
                             ". Each online episode is followed by a fixed number of updates, so that shorter "
                             "episodes make for more updates in the same interactions: compare the curves over "
                             "updates with those over interactions.";
}

// Own data of moves and of continuous actions are measured otherwise, also if their files have one name.
inline std::string section_name(const Run& run) {
    return data_name(run.settings) + (run.own() && run.settings.moves > 0 ? "-moves" : "");
}

// The section of runs of one task, preset and physics, sorted as Group says. Errors: report.same_seed.
inline Section make_section(const std::string& name, const Runs& runs, const std::string& out_folder) {
    const Settings& settings = runs.at(0)->settings;
    const bool mujoco = runs[0]->mujoco != nullptr, own = runs[0]->own();
    Group group{runs,
                name,
                "preset " + settings.preset + (mujoco ? ", physics " + settings.physics : ""),
                name + "-" + settings.preset + (settings.physics == "2.2" ? "-physics-2.2" : ""),
                mujoco ? "eval_score"
                : own  ? "held_out_error"
                       : "eval_length",
                mujoco ? "normalised score"
                : own  ? "action error, held out"
                       : "length",
                own ? 4 : 2,
                rows_of(runs)};
    name_differences(group);
    Section section{group.heading(), {method_table(group), run_table(group)}, verdict(group)};
    if (!group.in_all.rows.empty()) section.parts.emplace_back(group.in_all);
    if (const Table doses = dose_table(group); !doses.rows.empty()) {
        section.parts.emplace_back(
            "The dose: 1 - w is the share of the loss that is the memory's advice, a-hat in the place of a. It shifts "
            "what the policy is fitted to by (1 - w) (a-hat - a) at a step; on the grid world that much probability. "
            "Here: the mean length of these shifts, and the length of the mean shift, in which opposite ones cancel.");
        section.parts.emplace_back(doses);
    }
    (mujoco ? add_mujoco_task : own ? add_own_data : add_grid_world)(section.parts, group);
    if (const std::string sentence = updates_sentence(group); !sentence.empty()) section.parts.emplace_back(sentence);
    add_curves(section.parts, group, [](auto column) { return !column.starts_with("eval_"); });
    for (const Table& table : {settings_table(group), time_table(group)})
        if (!table.rows.empty()) section.parts.emplace_back(table);
    for (const Run* run : group.runs)
        if (!run->time_error.empty()) section.parts.emplace_back("A run has no times: " + run->time_error + ".");
    section.parts.emplace_back(command_table(group));
    for (const Row& row : group.rows)
        for (const Run* run : row.runs) {
            std::error_code error;  // writing the page will fail with a sentence
            const auto out = std::filesystem::absolute(out_folder, error);  // a relative path must exist
            const std::string folder = std::filesystem::relative(run->folder, out, error);
            section.parts.emplace_back(Files{row.name_of(*run), folder, run->files});
        }
    return section;
}

// The introduction, and a section for each group of runs.
inline std::vector<Section> make_sections(const std::vector<Run>& runs, const std::string& out_folder) {
    std::map<std::array<std::string, 3>, Runs> groups;
    std::map<std::string, std::string> names;  // of own data, by their checksum: the same data may have several names
    for (const Run& run : runs) {
        const std::string name = section_name(run);
        const std::string& first =
            run.own() ? names.try_emplace(run.settings.dataset_sha256, name).first->second : name;
        groups[{first, run.settings.preset, run.settings.physics}].push_back(&run);
    }
    const char* const numbers =
        "One section for each task, preset and physics. Runs with equal settings but for the seed are averaged; "
        "others stand apart, and a label in parentheses names the settings that differ from the preset and from other "
        "rows. All numbers come from the run folders, except those marked as the paper's. \"a ± b\": mean and "
        "standard deviation over seeds (n − 1; \"-\": one seed). Final: by the last evaluation of a run; last 10: "
        "mean over its last ten evaluations; an evaluation that came to nothing (nan in progress.csv) is passed over. "
        "\"Agrees\": our mean lies within the paper's standard deviation of the paper's mean (grid world: WODTEM 5, "
        "ODT 6.5 to 7.5).";
    const char* const figures =
        "Curves: each seed as a thin line, straight between its evaluations, which are dots where they can be told "
        "apart; the mean of these lines, which ends where the first of them ends; diamonds: the paper's final results; "
        "what lies beyond the frame is drawn on its edge, and the line below the title says how far it goes. "
        "DT has no online phase: its evaluation is a dashed line across. Bars: mean over seeds; strokes: from the "
        "lowest to the highest seed. A run's file settings has the value of every setting and where it came from.";
    std::vector<Section> sections{{"How to read this", {numbers, figures}}};
    for (const auto& group : groups) sections.push_back(make_section(group.first[0], group.second, out_folder));
    return sections;
}

}  // namespace results

// Writes report.html, report.md and the figures into `out_folder`; returns the tables as text for a terminal, and one
// sentence for each task that compares it with the paper. Errors: report.nothing, report.write, and those above.
inline std::string report(const std::vector<std::string>& folders, const std::string& out_folder) {
    using namespace results;
    if (folders.empty()) fail("report.nothing", "report: no run folder was given; give at least one");
    std::vector<Run> runs;
    for (const std::string& folder : folders)
        for (const std::string& one : run_folders(folder)) {
            try {
                runs.push_back(read_run(one));
            } catch (const Error& error) {
                if (one == folder) throw;  // it was asked for by name
                std::fprintf(stderr, "left out of the report: %s\n", error.what());
            }
        }
    if (runs.empty()) fail("report.nothing", "report: none of the runs found can be read; nothing was written");
    const auto order = [](const Run& run) { return std::tie(run.method, run.identity, run.settings.seed); };
    std::ranges::stable_sort(runs, {}, order);
    const std::vector<Section> sections = make_sections(runs, out_folder);

    std::error_code error;
    std::filesystem::create_directories(out_folder, error);
    if (error) fail("report.write", "%s: cannot make this folder: %s", out_folder.c_str(), error.message().c_str());
    const Markdown markdown;
    std::string text;
    for (const Section& section : sections) {
        if (&section != &sections[0]) text += markdown(section.heading);  // the first explains the pages
        for (const Part& part : section.parts) {
            if (const auto* table = std::get_if<Table>(&part); table && !table->pages_only) text += markdown(*table);
            if (const auto* figure = std::get_if<Figure>(&part))
                write_file_atomic(out_folder + "/" + figure->file, figure->svg);
        }
        if (!section.verdict.empty()) text += markdown(section.verdict);
    }
    const std::string title = "WODTEM: report on " + std::to_string(runs.size()) + (runs.size() > 1 ? " runs" : " run");
    write_file_atomic(out_folder + "/report.html", html_page(title, sections));
    write_file_atomic(out_folder + "/report.md", page(markdown, title, sections));
    return text;
}
