// report.hpp: run folders in, tables and figures out: report.html (one file that needs nothing else), its figures as
// SVG files, and report.md. Answers WODTEM figs. 1 and 4 (sec. IV-A, V-D); other tasks get the curves of score and
// length, and mazes the paths through them. One sentence for each task compares the runs with the paper.
//
// Reads from each folder:  settings            lines `name = value    # source`; task, method, preset, seed are needed
//                          progress.csv        one row per evaluation, the first at the end of the offline phase
//                          episodes.csv        one row per online episode (not for DT)
//                          finished            an empty file; without it the logs above count as far as they go
//   mazes, if it is there: paths.csv           one row per state of the latest evaluation's episodes
//   finished grid worlds:  policy.csv          probability of each move in each cell
//                          start_actions.csv   share of each move at S: learned, D_offline, D_online (not for DT)
// Promises: every number comes from these files or is marked as the paper's; equal folders give equal bytes; seeds are
// averaged only if nothing but the seed was set differently, and the physics were the same; errors name file and line.
// Leaves out: networks, statistics beyond mean and standard deviation, judging whether a difference matters.
// Order: settings; one run folder; numbers; words; the paper's results; figures; tables; the report.
#pragma once

#include <array>
#include <cstdint>
#include <filesystem>
#include <map>
#include <tuple>

#include "../gridworld.hpp"
#include "../mujoco_env.hpp"
#include "figures.hpp"
#include "safetensors.hpp"

// ---------------------------------------------------------------------------------------------------------------------
// Settings

struct Setting {
    std::string name, value;
    std::string source;  // "command line": whoever repeats the run must give the setting again
};

// Without the spaces and tabs at both ends.
inline std::string trimmed(std::string_view text) {
    const size_t first = text.find_first_not_of(" \t");
    if (first == std::string_view::npos) return "";
    return std::string(text.substr(first, text.find_last_not_of(" \t") + 1 - first));
}

// Reads lines `name = value # source`. Empty lines and lines that start with # are skipped. The first " = " ends a
// name, the first " # " after it a value. Errors: settings.line, settings.repeated, with `path` and the line.
inline std::vector<Setting> parse_settings(std::string_view text, const std::string& path) {
    std::vector<Setting> out;
    for (size_t line = 1; !text.empty(); ++line) {
        const size_t length = std::min(text.find('\n'), text.size());
        const std::string all = trimmed(text.substr(0, length));
        text.remove_prefix(std::min(text.size(), length + 1));
        if (all.empty() || all[0] == '#') continue;
        const size_t equals = all.find(" = "), hash = all.find(" # ", equals);  // npos if " = " is missing
        Setting setting;
        if (hash != std::string::npos)
            setting = {trimmed(all.substr(0, equals)), trimmed(all.substr(equals + 2, hash - equals - 2)),
                       trimmed(all.substr(hash + 3))};
        if (setting.value.empty())
            fail("settings.line", "%s: line %zu: expected \"name = value    # source\", got \"%s\"", path.c_str(), line,
                 all.c_str());
        if (std::any_of(out.begin(), out.end(), [&](const Setting& other) { return other.name == setting.name; }))
            fail("settings.repeated", "%s: line %zu: \"%s\" was set before; keep one of the lines", path.c_str(), line,
                 setting.name.c_str());
        out.push_back(setting);
    }
    return out;
}

namespace results {  // the training program has names of its own: Run, Spread, ...

// ---------------------------------------------------------------------------------------------------------------------
// One run folder

// How a method is shown, and what the paper says of it.
struct Method {
    const char* label;
    Colour colour;
    const char* paper_length;  // the grid world's final length in the paper, as text
    double shortest, longest;  // lengths that agree with that text; NaN: the paper gives no number
    const char* start_figure;  // the paper's figure of the actions at S
};
constexpr double none = std::numeric_limits<double>::quiet_NaN();
constexpr std::array<const char*, 3> method_names{"dt", "odt", "wodtem"};
constexpr std::array<Method, 3> methods{{
    {"DT", Colour::green, "no number (fig. 4a)", none, none, ""},
    {"ODT", Colour::blue, "about 7 (sec. IV-A)", 6.5, 7.5, "1d"},
    {"WODTEM", Colour::vermillion, "5 (sec. V-D)", 5, 5, "4b"},
}};

// One number in [0, 1] for each move, in the order of grid_move_table.
using MoveShares = std::array<double, grid_moves>;

struct MazeEpisode {
    double goal_x, goal_y;  // m, as observed
    bool reached;           // some state lies within goal_radius of the goal
    MazePath path;          // the same goal, and the states, on the map
};

struct Run {
    std::string folder;
    std::vector<Setting> settings;
    std::string task, preset;
    size_t method = 0;  // in method_names
    int64_t seed = 0;
    const MujocoTask* mujoco_task = nullptr;  // null: the grid world, or a task of which only the name is known
    Physics physics = Physics::d4rl;          // of a MuJoCo task, like the next
    std::string mujoco_version;
    bool finished = false;
    double so_far = 0;                                       // online interactions
    std::vector<double> interactions, length, total, score;  // of each evaluation; total: the return
    std::vector<double> episode_length, episode_return;      // of each online episode
    std::vector<MoveShares> policy;                          // [36], or empty
    std::array<std::vector<double>, 3> start_actions;        // learned, D_offline, D_online: [8] each, or empty
    std::vector<MazeEpisode> paths;                          // of the latest evaluation in a maze, or empty

    const Method& about_method() const { return methods[method]; }
    bool offline_only() const { return method == 0; }
};
using Runs = std::vector<const Run*>;         // of one method unless said otherwise, by seed; never empty
using Quantity = std::vector<double> Run::*;  // length, total or score

// The setting of this name, or one with the value `otherwise` and no source.
inline Setting setting_or(const Run& run, const std::string& name, const std::string& otherwise) {
    for (const Setting& setting : run.settings)
        if (setting.name == name) return setting;
    return {name, otherwise, ""};
}

// Returns a setting that must be a plain word, since titles, commands and file names contain it.
// Errors: report.setting.
inline std::string word_setting(const Run& run, const std::string& name) {
    const std::string value = setting_or(run, name, "").value;
    const std::string allowed = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789-._";
    if (value.empty() || value.find_first_not_of(allowed) != std::string::npos)
        fail("report.setting", "%s/settings: %s is \"%s\", expected a word of letters, digits and -._",
             run.folder.c_str(), name.c_str(), value.c_str());
    return value;
}

// Returns the place of a setting's value among `names`. Errors: report.setting.
template <size_t N>
size_t place_among(const std::array<const char*, N>& names, const Run& run, const char* name,
                   const std::string& value) {
    const auto found = std::find(names.begin(), names.end(), value);
    std::string known;
    for (const char* one : names) known += std::string(" ") + one;
    if (found == names.end())
        fail("report.setting", "%s/settings: %s is \"%s\", expected one of%s", run.folder.c_str(), name, value.c_str(),
             known.c_str());
    return static_cast<size_t>(found - names.begin());
}

// A CSV file with its path, which its errors name.
struct Log {
    std::string path;
    Table table;

    // `if_missing`: what an absent file holds; null: the file must be there.
    explicit Log(const std::string& file, const char* if_missing = nullptr) : path(file) {
        table = parse_csv(if_missing && !std::filesystem::exists(path) ? if_missing : read_file(path), path);
    }

    std::vector<double> column(const char* name) const { return numbers(table, name, path); }

    // A column without NaN whose values lie in [low, high]. Errors: report.range.
    std::vector<double> column(const char* name, double low, double high) const {
        const std::vector<double> out = column(name);
        for (size_t i = 0; i < out.size(); ++i)
            if (!(out[i] >= low && out[i] <= high))
                fail("report.range", "%s: line %zu: column \"%s\" holds %g, expected %g to %g", path.c_str(), i + 2,
                     name, out[i], low, high);
        return out;
    }

    // The column of online interactions, which must not fall. Errors: report.order.
    std::vector<double> interactions() const {
        const std::vector<double> out = column("interactions", 0, 1e15);
        for (size_t i = 1; i < out.size(); ++i)
            if (out[i] < out[i - 1])
                fail("report.order", "%s: line %zu: the interactions fall from %.0f to %.0f", path.c_str(), i + 2,
                     out[i - 1], out[i]);
        return out;
    }

    // A column must hold these texts, from top to bottom. Errors: report.rows.
    void check_column(const char* name, const std::vector<std::string>& expected) const {
        const std::vector<std::string> got = texts(table, name, path);
        const auto differs = std::mismatch(got.begin(), got.end(), expected.begin(), expected.end()).first;
        if (got != expected)
            fail("report.rows", "%s: line %zu: expected %zu rows below the header, in order of cells or moves",
                 path.c_str(), static_cast<size_t>(differs - got.begin()) + 2, expected.size());
    }
};

// policy.csv: 36 rows, one for each cell, with a column for each move. Errors: report.rows, report.range.
inline std::vector<MoveShares> read_policy(const Log& log) {
    std::vector<std::string> rows, columns;
    for (int cell = 0; cell < grid_cells; ++cell) {
        rows.push_back(std::to_string(cell / grid_size));
        columns.push_back(std::to_string(cell % grid_size));
    }
    log.check_column("row", rows);
    log.check_column("column", columns);
    std::vector<MoveShares> out(grid_cells);
    for (size_t move = 0; move < grid_moves; ++move) {
        const std::vector<double> column = log.column(grid_move_table[move].name, 0, 1);
        for (size_t cell = 0; cell < grid_cells; ++cell) out[cell][move] = column[cell];
    }
    return out;
}

// start_actions.csv: one row for each move. Errors: report.rows, report.range.
inline std::array<std::vector<double>, 3> read_start_actions(const Log& log) {
    std::vector<std::string> moves;
    for (const GridMove& move : grid_move_table) moves.emplace_back(move.name);
    log.check_column("move", moves);
    return {log.column("learned", 0, 1), log.column("offline", 0, 1), log.column("online")};  // NaN: no online phase
}

// Returns the place of an observed position (m) on the map, or beside it by less than the map's own size.
// Errors: report.range, with the file's line.
inline Place place_on_map(const MujocoTask& task, const char* what, double x, double y, const Log& log, size_t line) {
    const std::string_view map = task.maze;
    const auto rows = static_cast<double>(std::count(map.begin(), map.end(), '/'));
    const auto columns = static_cast<double>(map.find('/'));
    const auto [row, column] = maze_place(task, x, y);
    if (!(row > -rows && row < 2 * rows && column > -columns && column < 2 * columns))  // so it is for NaN
        fail("report.range",
             "%s: line %zu: the %s (%g, %g) is nowhere near the maze of %s; remove the file to report without it",
             log.path.c_str(), line, what, x, y, task.name);
    return {row, column};
}

// Episodes count from 0, and in each of them its steps; an episode keeps its goal.
// Errors: report.order, report.range, report.goal.
inline std::vector<MazeEpisode> read_paths(const MujocoTask& task, const Log& log) {
    const std::vector<double> episode = log.column("episode"), step = log.column("step", 0, task.max_episode_steps);
    const std::vector<double> goal_x = log.column("goal_x"), goal_y = log.column("goal_y");
    const std::vector<double> x = log.column("x"), y = log.column("y");
    std::vector<MazeEpisode> out;
    for (size_t i = 0; i < step.size(); ++i) {
        const size_t line = i + 2;
        if (step[i] == 0) out.push_back({goal_x[i], goal_y[i], false, {}});
        if (out.empty() || episode[i] != static_cast<double>(out.size() - 1) ||
            step[i] != static_cast<double>(out.back().path.places.size()))
            fail("report.order",
                 "%s: line %zu: episode %g, step %g does not follow from the line before; both count up from 0",
                 log.path.c_str(), line, episode[i], step[i]);
        MazeEpisode& latest = out.back();
        latest.path.goal = place_on_map(task, "goal", goal_x[i], goal_y[i], log, line);
        latest.path.places.push_back(place_on_map(task, "position", x[i], y[i], log, line));
        if (goal_x[i] != latest.goal_x || goal_y[i] != latest.goal_y)
            fail("report.goal", "%s: line %zu: the goal is not that of the episode's first line", log.path.c_str(),
                 line);
        latest.reached = latest.reached || std::hypot(x[i] - goal_x[i], y[i] - goal_y[i]) <= goal_radius;
    }
    return out;
}

// The settings and what follows from them. Errors: report.folder, report.setting.
inline void read_settings(Run& run) {
    const std::string path = run.folder + "/settings";
    if (!std::filesystem::exists(path))
        fail("report.folder", "%s: is no run folder: it has no file `settings`, which training writes first",
             run.folder.c_str());
    run.settings = parse_settings(read_file(path), path);
    run.task = word_setting(run, "task");
    run.preset = word_setting(run, "preset");
    run.method = place_among(method_names, run, "method", word_setting(run, "method"));
    const std::string seed = word_setting(run, "seed");
    const auto [end, error] = std::from_chars(seed.data(), seed.data() + seed.size(), run.seed);
    if (error != std::errc() || end != seed.data() + seed.size())
        fail("report.setting", "%s: seed is \"%s\", expected a whole number", path.c_str(), seed.c_str());
    run.mujoco_task = find_mujoco_task(run.task);
    if (!run.mujoco_task) return;
    run.physics = static_cast<Physics>(place_among(physics_names, run, "physics", word_setting(run, "physics")));
    run.mujoco_version = word_setting(run, "mujoco");
}

// progress.csv and episodes.csv. Errors: report.order, report.range, and those of parse_csv() and numbers().
inline void read_logs(Run& run) {
    // A run that has just begun may not have its logs yet.
    const Log evaluations(run.folder + "/progress.csv",
                          run.finished ? nullptr : "interactions,eval_length,eval_return,eval_score\n");
    run.interactions = evaluations.interactions();
    run.length = evaluations.column("eval_length");
    run.total = evaluations.column("eval_return");
    run.score = evaluations.column("eval_score");
    if (!run.interactions.empty()) run.so_far = run.interactions.back();
    if (run.offline_only()) return;
    const Log episodes(run.folder + "/episodes.csv", run.finished ? nullptr : "interactions,length,return\n");
    const std::vector<double> at = episodes.interactions();
    run.episode_length = episodes.column("length", 1, run.task == "gridworld" ? grid_max_steps : 1e9);
    run.episode_return = episodes.column("return");
    if (!at.empty()) run.so_far = std::max(run.so_far, at.back());
}

// All files of one run folder. Errors: those of the functions above.
inline Run read_run(const std::string& folder) {
    Run run;
    run.folder = folder;
    read_settings(run);
    run.finished = std::filesystem::exists(folder + "/finished");
    const std::string paths = folder + "/paths.csv";  // missing in a run that has just begun
    if (run.mujoco_task && run.mujoco_task->maze && std::filesystem::exists(paths))
        run.paths = read_paths(*run.mujoco_task, Log(paths));
    read_logs(run);
    if (run.task != "gridworld" || !run.finished) return run;
    run.policy = read_policy(Log(folder + "/policy.csv"));
    if (!run.offline_only()) run.start_actions = read_start_actions(Log(folder + "/start_actions.csv"));
    return run;
}

// ---------------------------------------------------------------------------------------------------------------------
// From runs to numbers. NaN: there is none.

struct Spread {
    size_t count = 0;         // of values that are not NaN
    double mean = none;       // of these
    double deviation = none;  // standard deviation with count - 1
};

// NaN values do not count.
inline Spread spread_of(std::vector<double> values) {
    std::erase_if(values, [](double value) { return std::isnan(value); });
    Spread out{values.size(), none, none};
    const auto n = static_cast<double>(values.size());
    double sum = 0, squares = 0;
    for (const double value : values) sum += value;
    if (n > 0) out.mean = sum / n;
    for (const double value : values) squares += (value - out.mean) * (value - out.mean);
    if (n > 1) out.deviation = std::sqrt(squares / (n - 1));
    return out;
}

// Appends the mean and the deviation over runs of each entry of row_of(run), a list that is equally long for all runs.
// A single run has no deviation.
template <class RowOf>
void append_spread(std::vector<double>& mean, std::vector<double>& deviation, const Runs& runs, RowOf row_of) {
    std::vector<std::vector<double>> rows;
    for (const Run* run : runs) rows.push_back(row_of(*run));
    for (size_t i = 0; i < rows.at(0).size(); ++i) {
        std::vector<double> values;
        for (const std::vector<double>& row : rows) values.push_back(row[i]);
        mean.push_back(spread_of(values).mean);
        if (rows.size() > 1) deviation.push_back(spread_of(values).deviation);
    }
}

// The last y that is not NaN and whose x is not above `at`; x does not fall.
inline double last_until(const std::vector<double>& x, const std::vector<double>& y, double at) {
    double out = none;
    for (size_t i = 0; i < x.size() && x[i] <= at; ++i)
        if (!std::isnan(y[i])) out = y[i];
    return out;
}
// The value of the last evaluation that has one.
inline double final_value(const Run& run, Quantity quantity) {
    return last_until(run.interactions, run.*quantity, 1e15);
}

// Mean over the last ten evaluations (or all, if there are fewer): one evaluation of a policy that wavers says little.
inline double last_ten(const Run& run, Quantity quantity) {
    const std::vector<double>& y = run.*quantity;
    double sum = 0, count = 0;
    for (size_t i = y.size(); i-- > 0 && count < 10;) {
        if (std::isnan(y[i])) continue;
        sum += y[i];
        ++count;
    }
    return count > 0 ? sum / count : none;
}

// Spread over runs of final_value or last_ten.
inline Spread spread_of(const Runs& runs, double (*number_of)(const Run&, Quantity), Quantity quantity) {
    std::vector<double> values;
    for (const Run* run : runs) values.push_back(number_of(*run, quantity));
    return spread_of(values);
}

// Seeds are evaluated at different interactions, so all are drawn at 0, 250, 500, ... up to the largest of any run;
// long runs in larger steps, at most about 400.
inline std::vector<double> curve_points(const std::vector<Runs>& by_method) {
    double largest = 0;
    for (const Runs& runs : by_method)
        for (const Run* run : runs) largest = std::max(largest, run->so_far);
    const double step = 250 * std::max(1.0, std::ceil(largest / 250 / 400));
    std::vector<double> out;
    for (double at = 0; at <= largest; at += step) out.push_back(at);
    return out;
}

// A finished run keeps its final value to the end, and shows it at the last point even if it fell a little later; an
// unfinished one ends at its own last interactions.
inline std::vector<double> resampled(const Run& run, Quantity quantity, const std::vector<double>& points) {
    std::vector<double> out;
    for (const double at : points) {
        const bool over = !run.finished && at > run.so_far, last = run.finished && at == points.back();
        out.push_back(over ? none : last_until(run.interactions, run.*quantity, last ? 1e15 : at));
    }
    return out;
}

// The interactions of the first evaluation from which on every one had this length.
inline double kept_from(const Run& run, double length) {
    double from = none;
    for (size_t i = 0; i < run.length.size(); ++i)
        from = run.length[i] != length ? none : std::isnan(from) ? run.interactions[i] : from;
    return from;
}

// The shortest online episode that reached the goal.
inline double shortest_met(const Run& run) {
    double out = none;
    for (size_t i = 0; i < run.episode_length.size(); ++i)
        if (run.episode_return[i] == 1) out = std::fmin(out, run.episode_length[i]);  // fmin ignores NaN
    return out;
}

// The last length of each bar: 5 (less only on a torus), 6, ..., 10, 11 to 15, ...
constexpr std::array<int, 12> bin_ends{5, 6, 7, 8, 9, 10, 15, 20, 30, 50, 99, 100};

// How many of the lengths belong to each bar.
inline std::vector<double> count_lengths(const std::vector<double>& lengths) {
    std::vector<double> out(bin_ends.size(), 0);
    for (const double length : lengths) {
        const auto bin = std::lower_bound(bin_ends.begin(), bin_ends.end() - 1, length);
        out[bin - bin_ends.begin()] += 1;
    }
    return out;
}

// The index of the most likely move; of equally likely ones the first.
inline size_t most_likely(const MoveShares& shares) {
    return static_cast<size_t>(std::max_element(shares.begin(), shares.end()) - shares.begin());
}

// Cells from S on by the most likely moves, up to G or to the last before a cell would come again.
inline std::vector<int> greedy_path(const std::vector<MoveShares>& policy, EdgeRule edge) {
    std::vector<int> path{grid_start};
    while (path.back() != grid_goal) {
        const size_t move = most_likely(policy[static_cast<size_t>(path.back())]);
        const int next = next_cell(edge, path.back(), static_cast<int>(move));
        if (std::find(path.begin(), path.end(), next) != path.end()) break;
        path.push_back(next);
    }
    return path;
}

// ---------------------------------------------------------------------------------------------------------------------
// Words

// A number for a table; "-" for NaN.
inline std::string shown(double value, int decimals) {
    if (value == 0 && decimals == 2) return "0.00";  // an axis would say 0
    return std::isnan(value) ? "-" : svg::tick_text(value, decimals);
}

// "5.00 ± 0.00"; "5.00 ± -" for one value; "-" for none.
inline std::string plus_minus(const Spread& spread) {
    return spread.count == 0 ? "-" : shown(spread.mean, 2) + " ± " + shown(spread.deviation, 2);
}

// The same of final_value or last_ten over runs.
inline std::string mean_text(const Runs& runs, double (*number_of)(const Run&, Quantity), Quantity quantity) {
    return plus_minus(spread_of(runs, number_of, quantity));
}

// "20,050"; "20,050–20,712" if they differ.
inline std::string interactions_text(const Runs& runs) {
    const auto [least, most] =
        std::minmax_element(runs.begin(), runs.end(), [](const Run* a, const Run* b) { return a->so_far < b->so_far; });
    return shown((*least)->so_far, 0) + ((*least)->so_far < (*most)->so_far ? "–" + shown((*most)->so_far, 0) : "");
}

// "7", or "7–9"
inline std::string whole_range(int64_t first, int64_t last) {
    return std::to_string(first) + (first < last ? "–" + std::to_string(last) : "");
}

// "≤ 5", "6", "11–15"
inline std::string bin_label(size_t bin) {
    return bin == 0 ? "≤ 5" : whole_range(bin_ends[bin - 1] + 1, bin_ends[bin]);
}

// Seeds 0 1 2 5 -> (0, 2), (5, 5).
inline std::vector<std::pair<int64_t, int64_t>> seed_ranges(const Runs& runs) {
    std::vector<std::pair<int64_t, int64_t>> out;
    for (const Run* run : runs) {
        if (out.empty() || out.back().second + 1 != run->seed) out.emplace_back(run->seed, run->seed);
        out.back().second = run->seed;
    }
    return out;
}

// "ODT seeds 0–2, 5"
inline std::string name_of(const Runs& runs) {
    std::string out = runs.at(0)->about_method().label, before = runs.size() > 1 ? " seeds " : " seed ";
    for (const auto& [first, last] : seed_ranges(runs)) {
        out += before + whole_range(first, last);
        before = ", ";
    }
    return out;
}
inline std::string name_of(const std::vector<Runs>& by_method) {
    std::string out;
    for (const Runs& runs : by_method) out += (out.empty() ? "" : "; ") + name_of(runs);
    return out;
}

// The runs that have finished; may be empty.
inline Runs only_finished(Runs runs) {
    std::erase_if(runs, [](const Run* run) { return !run->finished; });
    return runs;
}

// "5", "5 (2 unfinished)"
inline std::string seed_count(const Runs& runs) {
    const size_t open = runs.size() - only_finished(runs).size();
    return std::to_string(runs.size()) + (open > 0 ? " (" + std::to_string(open) + " unfinished)" : "");
}

// `sentence` if any run is unfinished.
inline std::string if_unfinished(const std::vector<Runs>& by_method, const char* sentence) {
    for (const Runs& runs : by_method)
        if (only_finished(runs).size() < runs.size()) return sentence;
    return "";
}

// As settings name it: "d4rl" or "2.2".
inline std::string physics_name(const Run& run) { return physics_names[static_cast<size_t>(run.physics)]; }

// "physics d4rl on MuJoCo 2.2.2"
inline std::string physics_of(const Run& run) {
    return "physics " + physics_name(run) + " on MuJoCo " + run.mujoco_version;
}

// What the command line set beyond task, method, preset, seed and physics: " --set width=64".
inline std::string other_options(const Run& run) {
    const std::array<std::string, 5> named{"task", "method", "preset", "seed", "physics"};
    std::string out;
    for (const auto& [name, value, source] : run.settings)
        if (source == "command line" && std::find(named.begin(), named.end(), name) == named.end())
            out += " --set " + name + "=" + value;
    return out;
}

// ---------------------------------------------------------------------------------------------------------------------
// The paper's results, and one sentence that compares a task's runs with them

struct PaperScore {
    double mean, deviation;
};
// One row of Table III.
struct PaperScores {
    const char* task;  // without the version
    std::array<PaperScore, 3> by_method;
};
// WODTEM Table III: normalised scores after 200,000 online interactions, over five seeds; DT, ODT, WODTEM.
constexpr std::array<PaperScores, 13> paper_scores{{
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
}};

// "5.00", or with several seeds "53.50 ± 65.76".
inline std::string short_text(const Spread& spread) {
    return spread.count > 1 ? plus_minus(spread) : shown(spread.mean, 2);
}

// "takes 100.00 steps (return 0.00), never reaching the goal, which does not agree with the paper: about 7, ..."
inline std::string compare_grid_world(const Runs& runs) {
    const Method& method = runs[0]->about_method();
    const Spread length = spread_of(runs, final_value, &Run::length);
    const Spread total = spread_of(runs, final_value, &Run::total);
    std::string out = "takes " + short_text(length) + " steps (return " + short_text(total) + ")";
    if (total.mean == 0) out += ", never reaching the goal";
    if (length.mean == 5) out += ", the shortest path";
    if (std::isnan(method.shortest)) return out + "; the paper gives " + method.paper_length;
    const bool agrees = length.mean >= method.shortest && length.mean <= method.longest && total.mean == 1;
    return out + (agrees ? ", which agrees" : ", which does not agree") + " with the paper: " + method.paper_length +
           ", return 1";
}

// "scores 17.35, below the paper's 75.18 ± 10.79"; "within" means by at most the paper's standard deviation.
inline std::string compare_scores(const Runs& runs, const PaperScore& paper) {
    const Spread score = spread_of(runs, final_value, &Run::score);
    const double difference = score.mean - paper.mean;
    const char* relation = std::fabs(difference) <= paper.deviation ? "within" : difference < 0 ? "below" : "above";
    return "scores " + short_text(score) + ", " + relation + " the paper's " + shown(paper.mean, 2) + " ± " +
           shown(paper.deviation, 2);
}

// Compares each method with the paper in one sentence, WODTEM first; "" where the paper has no result. The sentence
// ends with what else differs from the paper's experiment: the number of interactions, and the data set.
inline std::string compare_with_paper(const std::string& heading, const std::vector<Runs>& by_method) {
    const Run& any = *by_method.at(0)[0];
    const bool gridworld = any.task == "gridworld";
    const auto paper = std::find_if(paper_scores.begin(), paper_scores.end(), [&](const PaperScores& row) {
        return any.task.starts_with(std::string(row.task) + "-v");
    });
    if (!gridworld && paper == paper_scores.end()) return "";
    std::string out, interactions;
    for (size_t i = by_method.size(); i-- > 0;) {
        const Runs& runs = by_method[i];
        const std::string label = runs[0]->about_method().label;
        out += (out.empty() ? heading + ": " : "; ") + label + if_unfinished({runs}, " (unfinished)") + " ";
        if (spread_of(runs, final_value, gridworld ? &Run::length : &Run::score).count == 0)
            out += "has no result yet";
        else
            out += gridworld ? compare_grid_world(runs) : compare_scores(runs, paper->by_method[runs[0]->method]);
        if (!runs[0]->offline_only()) interactions += label + " " + interactions_text(runs) + ", ";
    }
    if (!interactions.empty())
        out += "; online interactions: " + interactions + "paper " + (gridworld ? "20,000" : "200,000");
    const std::string data = setting_or(any, "dataset", "").source;
    if (!gridworld && !data.empty() && data != "D4RL's published file") out += "; the data set is not D4RL's file";
    return out + ".";
}

// ---------------------------------------------------------------------------------------------------------------------
// Figures of one task and preset

// Means over seeds: a curve for each method that interacts, a line across for DT.
inline LineChart mean_chart(const std::vector<Runs>& by_method, Quantity quantity, const std::string& title,
                            const std::string& y_label) {
    LineChart chart{title, "online interactions", y_label, {}, {}};
    chart.cut_x = by_method.at(0)[0]->task != "gridworld";  // else the last episode may overrun a round budget
    for (const Runs& runs : by_method) {
        const Method& method = runs[0]->about_method();
        Series series{method.label, method.colour, curve_points(by_method), {}, {}};
        append_spread(series.mean, series.deviation, runs,
                      [&](const Run& run) { return resampled(run, quantity, series.x); });
        if (!runs[0]->offline_only())
            chart.series.push_back(series);
        else if (!std::isnan(series.mean[0]))  // no online phase: a line across, as in fig. 4a
            chart.references.push_back({series.label, series.colour, series.mean[0]});
    }
    return chart;
}

// How to read the curves of mean_chart().
inline std::string curve_caption(const std::vector<Runs>& by_method) {
    const bool dt = by_method.at(0)[0]->offline_only();
    return name_of(by_method) +
           ". Lines: mean over seeds; bands: one standard deviation to either side, none for one seed." +
           (dt ? " DT has no online phase and is the dashed line, its mean over seeds." : "") +
           " Seeds are evaluated at different interactions; drawn at equal steps (of 250 interactions in a short run), "
           "each seed by its last evaluation until then, and at the last point by its final one." +
           if_unfinished(by_method,
                         " Unfinished seeds count up to their own last interactions, so that a line may jump where one "
                         "of them ends.");
}

// Figs. 1b, 4a
inline void add_length_curve(Section& section, const std::vector<Runs>& by_method, const std::string& name) {
    LineChart chart = mean_chart(by_method, &Run::length, "Evaluation length during online training",
                                 "evaluation length, steps (log scale)");
    chart.references.push_back({"shortest path, 5 steps", Colour::black, 5});
    chart.log_y = true;
    chart.y_floor = 5;
    section.figures.push_back({line_chart(chart),
                               "Compare with figs. 1b and 4a of the paper. " + curve_caption(by_method) +
                                   " An episode ends at the goal or after 100 steps.",
                               name + "-length.svg"});
}

// Fig. 1c
inline void add_histogram(Section& section, const std::vector<Runs>& by_method, const std::string& name) {
    BarChart chart{
        "Lengths of the online episodes", "episode length, steps", "mean number of episodes per seed", {}, {}};
    for (size_t bin = 0; bin < bin_ends.size(); ++bin) chart.categories.push_back(bin_label(bin));
    for (const Runs& runs : by_method) {
        Bars& bars = chart.series.emplace_back(runs[0]->about_method().label, runs[0]->about_method().colour);
        append_spread(bars.values, bars.deviation, runs,
                      [](const Run& run) { return count_lengths(run.episode_length); });
    }
    section.figures.push_back(
        {bar_chart(chart),
         "Compare with fig. 1c of the paper. " + name_of(by_method) +
             ". How many of the episodes met in online training had which length; from 11 on a bar covers a "
             "range of lengths, and 100 is the time limit. Bars: mean over seeds; strokes: one standard "
             "deviation to either side." +
             if_unfinished(by_method, " Unfinished seeds count with their episodes so far."),
         name + "-episodes.svg"});
}

// Figs. 1d, 4b; of finished runs.
inline void add_start_actions(Section& section, const Runs& runs, const std::string& name) {
    const Method& method = runs[0]->about_method();
    BarChart chart{std::string("Actions at S: ") + method.label, "move", "share", {}, {}};
    for (const GridMove& move : grid_move_table) chart.categories.emplace_back(move.name);
    chart.series = {{"learned policy", method.colour, {}, {}},
                    {"D_offline", Colour::sky, {}, {}},
                    {"D_online", Colour::purple, {}, {}}};
    for (size_t k = 0; k < 3; ++k)
        append_spread(chart.series[k].values, chart.series[k].deviation, runs,
                      [&](const Run& run) { return run.start_actions[k]; });
    section.figures.push_back(
        {bar_chart(chart),
         std::string("Compare with fig. ") + method.start_figure + " of the paper. " + name_of(runs) +
             ", finished. Share of each move at the start cell S: its probability under the learned policy, and "
             "its frequency in D_offline and, at the end, in D_online. Bars: mean over seeds; strokes: one "
             "standard deviation to either side. R, D, L, U: right, down, left, up.",
         name + "-start-" + method_names[runs[0]->method] + ".svg"});
}

// Fig. 1a shows the shortest path in this way; the paper does not show a learned one.
inline void add_grid(Section& section, const Run& run, const std::string& name) {
    const auto cell_at = [](int cell) { return Cell{cell / grid_size, cell % grid_size}; };
    const std::string who = name_of(Runs{&run});
    GridPolicy grid{"Learned policy: " + who, grid_size, grid_size, {}, cell_at(grid_start), cell_at(grid_goal), {}};
    for (const MoveShares& shares : run.policy) {
        const GridMove& move = grid_move_table[most_likely(shares)];
        grid.arrows.push_back({move.row_change, move.column_change, shares[most_likely(shares)]});
    }
    grid.arrows[grid_goal] = {0, 0, 0};  // no move is made there
    const size_t edge = place_among(edge_rule_names, run, "edge", setting_or(run, "edge", "clipped").value);
    const std::vector<int> path = greedy_path(run.policy, static_cast<EdgeRule>(edge));
    for (const int cell : path) grid.path.push_back(cell_at(cell));
    const std::string steps = std::to_string(path.size() - 1) + (path.size() == 2 ? " step" : " steps");
    const std::string end = path.back() == grid_goal ? "They reach G in " + steps
                                                     : "They do not reach G: after " + steps +
                                                           " the next move leads to a cell visited before";
    section.figures.push_back(
        {grid_policy(grid),
         "Compare the blue cells with fig. 1a of the paper. " + who +
             ", finished. Arrows: the most likely move in each cell; blue: the cells that these moves visit from "
             "S on. " +
             end + ". Moves off the grid: " + edge_rule_names[edge] + ".",
         name + "-grid-" + method_names[run.method] + ".svg"});
}

constexpr size_t paths_drawn = 10;  // at most; more would hide each other

// The latest evaluation of one run, in a maze.
inline void add_paths(Section& section, const Run& run, const std::string& name) {
    const bool ant = run.mujoco_task->rules == Rules::antmaze;
    const std::string radius = svg::number(goal_radius) + " m";
    MazePaths maze{run.task + ": paths of " + name_of(Runs{&run}),
                   run.mujoco_task->maze,
                   goal_radius / maze_cell_length(*run.mujoco_task),
                   "goal (radius " + radius + ")",
                   {}};
    for (size_t i = 0; i < std::min(run.paths.size(), paths_drawn); ++i) maze.paths.push_back(run.paths[i].path);
    const auto reached =
        std::count_if(run.paths.begin(), run.paths.end(), [](const MazeEpisode& one) { return one.reached; });
    std::string caption = name_of(Runs{&run}) + (run.finished ? "" : ", unfinished") + ": its latest evaluation";
    if (!run.interactions.empty()) caption += ", at " + shown(run.interactions.back(), 0) + " online interactions";
    caption += ", " + physics_of(run) + ". " + std::to_string(reached) + " of " + std::to_string(run.paths.size()) +
               " episodes came within " + radius + " of the goal" +
               (ant ? ", which ended them; each has a goal of its own, circled in its colour."
                    : " at some time. None ends there: the score counts the steps within that distance.");
    if (run.paths.size() > paths_drawn) caption += " The first " + std::to_string(paths_drawn) + " are drawn.";
    caption += std::string(" The maze as its map is printed, walls grey; x runs ") +
               (ant ? "to the right and y downwards." : "downwards and y to the right.");
    section.figures.push_back({maze_paths(maze), caption, name + "-paths-" + method_names[run.method] + ".svg"});
}

// ---------------------------------------------------------------------------------------------------------------------
// Sections, each of one task, preset and physics

// The grid world's first table: one row for each method.
inline Table gridworld_table(const std::vector<Runs>& by_method) {
    Table table{{"Method", "Seeds", "Final length", "Mean of last 10", "Final return", "Ends at 5", "Paper: length"},
                {}};
    for (const Runs& runs : by_method) {
        const auto kept = [](const Run* run) { return !std::isnan(kept_from(*run, 5)); };
        const std::string at_five = std::to_string(std::count_if(runs.begin(), runs.end(), kept));
        const Method& method = runs[0]->about_method();
        table.rows.push_back({method.label, seed_count(runs), mean_text(runs, final_value, &Run::length),
                              mean_text(runs, last_ten, &Run::length), mean_text(runs, final_value, &Run::total),
                              at_five + " of " + std::to_string(runs.size()), method.paper_length});
    }
    return table;
}

// The grid world's second table: one row for each run.
inline Table gridworld_runs(const std::vector<Runs>& by_method) {
    Table table{{"Run", "State", "Final length", "Last 10", "Final return", "Shortest met", "At 5 from", "Folder"}, {}};
    for (const Runs& runs : by_method)
        for (const Run* run : runs) {
            const double from = kept_from(*run, 5);
            const std::string at_five = run->length.empty() ? "-" : std::isnan(from) ? "never" : shown(from, 0);
            table.rows.push_back(
                {name_of(Runs{run}), run->finished ? "finished" : "unfinished, at " + shown(run->so_far, 0),
                 shown(final_value(*run, &Run::length), 2), shown(last_ten(*run, &Run::length), 2),
                 shown(final_value(*run, &Run::total), 2), shown(shortest_met(*run), 0), at_five, run->folder});
        }
    return table;
}

// Tables and figures of the grid world, in the paper's order of figures.
inline void add_gridworld(Section& section, const std::vector<Runs>& by_method, const std::string& name) {
    section.tables = {gridworld_table(by_method), gridworld_runs(by_method)};
    section.paragraphs.push_back(
        "Final: by the last evaluation of a run; mean of last 10: over its last ten evaluations; lengths in steps. "
        "Shortest met: the shortest online episode that reached the goal. At 5 from: the online interactions of the "
        "first evaluation from which on every one took 5 steps, the length of the shortest path (0: from the end of "
        "offline training on).");
    std::vector<Runs> online = by_method;
    std::erase_if(online, [](const Runs& runs) { return runs[0]->offline_only(); });
    add_length_curve(section, by_method, name);
    if (!online.empty()) add_histogram(section, online, name);
    for (const Runs& runs : online)
        if (const Runs finished = only_finished(runs); !finished.empty()) add_start_actions(section, finished, name);
    for (const Runs& runs : by_method)
        if (const Runs finished = only_finished(runs); !finished.empty()) add_grid(section, *finished[0], name);
}

// True if an episode can end before the time limit.
inline bool ends_early(const MujocoTask& task) {
    return task.rules != Rules::maze2d && task.rules != Rules::halfcheetah;
}

// What a section's numbers rest on: the physics, the returns of scores 0 and 100, the end of an episode.
inline std::string about_physics(const Run& run) {
    const MujocoTask& task = *run.mujoco_task;
    return "All runs: " + physics_of(run) + ", masses and inertias as " +
           (run.physics == Physics::d4rl ? "in MuJoCo up to 2.1.0, which made D4RL's data"
                                         : "MuJoCo 2.2 computes them from the geometry") +
           ". Score 0 is a mean return of " + shown(task.score_low, 2) + ", score 100 one of " +
           shown(task.score_high, 2) + ". " +
           (task.rules == Rules::antmaze ? "An episode ends at the goal, or after "
            : ends_early(task)           ? "An episode ends when the body leaves gym's healthy range, or after "
                                         : "Every episode takes ") +
           shown(task.max_episode_steps, 0) + " steps.";
}

// Any other task's table: one row for each method.
inline Table score_table(const std::vector<Runs>& by_method) {
    Table table{{"Method", "Seeds", "Final normalised score", "Mean of last 10 scores", "Final return", "Final length",
                 "Interactions"},
                {}};
    for (const Runs& runs : by_method)
        table.rows.push_back({runs[0]->about_method().label, seed_count(runs),
                              mean_text(runs, final_value, &Run::score), mean_text(runs, last_ten, &Run::score),
                              mean_text(runs, final_value, &Run::total), mean_text(runs, final_value, &Run::length),
                              interactions_text(runs)});
    return table;
}

// Any other task: scores where the runs have them, else returns.
inline void add_other_task(Section& section, const std::vector<Runs>& by_method, const std::string& name) {
    const Run& any = *by_method.at(0)[0];
    const bool scored = std::any_of(by_method.begin(), by_method.end(), [](const Runs& runs) {
        return spread_of(runs, final_value, &Run::score).count > 0;
    });
    section.tables.push_back(score_table(by_method));
    if (any.mujoco_task) section.paragraphs.push_back(about_physics(any));
    const std::string physics = any.mujoco_task ? " Runs with " + physics_of(any) + "." : "";

    const char* label = scored ? "normalised score" : "return";
    section.figures.push_back(
        {line_chart(mean_chart(by_method, scored ? &Run::score : &Run::total, any.task + ": " + label, label)),
         curve_caption(by_method) + (any.mujoco_task && scored ? " Score 0: a random policy; 100: an expert." : "") +
             physics,
         name + "-curve.svg"});
    if (!any.mujoco_task || ends_early(*any.mujoco_task))  // else a flat line
        section.figures.push_back({line_chart(mean_chart(by_method, &Run::length, any.task + ": evaluation length",
                                                         "evaluation length, steps")),
                                   name_of(by_method) + ". Lines and bands as in the figure before." + physics,
                                   name + "-length.svg"});
    for (const Runs& runs : by_method) {
        const auto with_paths =
            std::find_if(runs.begin(), runs.end(), [](const Run* run) { return !run->paths.empty(); });
        if (with_paths != runs.end()) add_paths(section, **with_paths, name);
    }
}

// A section has runs on one version of the library, since versions may differ in every digit; a mean over seeds needs
// each seed once and nothing else different. Errors: report.mujoco, report.same_seed, report.options.
inline void check_comparable(const Runs& runs) {
    for (size_t i = 1; i < runs.size(); ++i) {
        const Run &a = *runs[i - 1], &b = *runs[i];
        const char *first = a.folder.c_str(), *second = b.folder.c_str();
        if (a.mujoco_version != b.mujoco_version)
            fail("report.mujoco", "%s was run on MuJoCo %s and %s on MuJoCo %s; report them apart", first,
                 a.mujoco_version.c_str(), second, b.mujoco_version.c_str());
        if (a.method != b.method) continue;
        if (a.seed == b.seed)
            fail("report.same_seed", "%s and %s are the same method with the same seed; give only one of them", first,
                 second);
        if (other_options(a) != other_options(b))
            fail("report.options", "%s was run with \"%s\" and %s with \"%s\"; report them apart", first,
                 trimmed(other_options(a)).c_str(), second, trimmed(other_options(b)).c_str());
    }
}

// The commands that made the runs, one for each unbroken range of seeds.
inline Table repeat_table(const std::vector<Runs>& by_method) {
    Table table{{"To repeat these runs", "Arithmetic"}, {}};
    for (const Runs& runs : by_method) {
        const Run& any = *runs[0];
        std::string arithmetic;  // each seed's
        for (const Run* run : runs) {
            const std::string one = setting_or(*run, "arithmetic", "not recorded").value;
            if (arithmetic.find(one) == std::string::npos) arithmetic += (arithmetic.empty() ? "" : ", ") + one;
        }
        const std::string physics = any.mujoco_task ? " --physics " + physics_name(any) : "";
        for (const auto& [first, last] : seed_ranges(runs)) {
            const std::string seeds = first < last ? " --seeds " + std::to_string(first) + "-" + std::to_string(last)
                                                   : " --seed " + std::to_string(first);
            table.rows.push_back({"wodtem train " + any.task + " --method " + method_names[any.method] + " --preset " +
                                      any.preset + seeds + physics + other_options(any),
                                  arithmetic});
        }
    }
    return table;
}

// The section of runs of one task, preset and physics, which are sorted by method, then by seed.
inline Section make_section(const Runs& runs) {
    std::vector<Runs> by_method;
    for (const Run* run : runs) {
        if (by_method.empty() || by_method.back()[0]->method != run->method) by_method.emplace_back();
        by_method.back().push_back(run);
    }
    check_comparable(runs);
    const Run& any = *runs.at(0);
    std::string name = any.task + "-" + any.preset;  // of the figures' files
    Section section;
    section.heading = any.task + ", preset " + any.preset;
    if (any.mujoco_task) section.heading += ", physics " + physics_name(any);
    if (any.physics != Physics::d4rl) name += "-physics-" + physics_name(any);
    section.verdict = compare_with_paper(section.heading, by_method);
    (any.task == "gridworld" ? add_gridworld : add_other_task)(section, by_method, name);
    section.tables.push_back(repeat_table(by_method));
    return section;
}

inline const char* how_to_read =
    "One section for each task and preset. All numbers come from the run folders, except those marked as the paper's. "
    "\"a ± b\": mean and standard deviation over seeds (n − 1; \"-\": one seed). A run that has not finished is "
    "marked so and counts with its latest evaluation. The last table has the commands that repeat the runs; the file "
    "settings in a run's folder has the value of every setting and where it came from.";
inline const char* how_to_read_scores =
    "Normalised score, as D4RL defines it: 0 for the return of a random policy, 100 for that of an expert, linear "
    "between and beyond; each section gives both returns. Final: by the last evaluation of a run; mean of last 10: "
    "over its last ten evaluations; an evaluation that came to nothing (nan in progress.csv) is passed over. Lengths "
    "are in steps. Interactions: online, of each run, from the least to the most. Runs with different physics stand in "
    "sections of their own and are never averaged.";

// The introduction, and a section for each group of runs.
inline std::vector<Section> make_sections(const std::vector<Run>& runs) {
    std::map<std::tuple<std::string, std::string, Physics>, Runs> groups;
    for (const Run& run : runs) groups[{run.task, run.preset, run.physics}].push_back(&run);
    std::vector<Section> sections{{"How to read this", {how_to_read}, {}, {}}};
    if (std::any_of(runs.begin(), runs.end(), [](const Run& run) { return run.mujoco_task != nullptr; }))
        sections[0].paragraphs.push_back(how_to_read_scores);
    for (const auto& group : groups) sections.push_back(make_section(group.second));
    return sections;
}

}  // namespace results

// Writes report.html, report.md and the figures into `out_folder`; returns the tables as text for a terminal, and one
// sentence for each task that compares it with the paper. Errors: report.nothing, report.write, and those above.
inline std::string report(const std::vector<std::string>& folders, const std::string& out_folder) {
    using namespace results;
    if (folders.empty()) fail("report.nothing", "report: no run folder was given; give at least one");
    std::vector<Run> runs;
    for (const std::string& folder : folders) runs.push_back(read_run(folder));
    std::stable_sort(runs.begin(), runs.end(), [](const Run& a, const Run& b) {
        return std::tie(a.task, a.preset, a.method, a.seed) < std::tie(b.task, b.preset, b.method, b.seed);
    });
    const std::vector<Section> sections = make_sections(runs);

    std::error_code error;
    std::filesystem::create_directories(out_folder, error);
    if (error) fail("report.write", "%s: cannot make this folder: %s", out_folder.c_str(), error.message().c_str());
    std::string text;
    for (const Section& section : sections) {
        for (const Figure& figure : section.figures) write_file_atomic(out_folder + "/" + figure.file, figure.svg);
        if (!section.tables.empty()) text += section.heading + "\n\n";
        for (const Table& table : section.tables) text += text_table(table) + "\n";
        if (!section.verdict.empty()) text += section.verdict + "\n\n";
    }
    const std::string title =
        "WODTEM: report on " + std::to_string(runs.size()) + (runs.size() == 1 ? " run" : " runs");
    write_file_atomic(out_folder + "/report.html", html_page(title, sections));
    write_file_atomic(out_folder + "/report.md", markdown_page(title, sections));
    return text;
}
