// report.hpp: run folders in, tables and figures out: report.html (one file that needs nothing else), its figures as
// SVG files, and report.md. Answers WODTEM figs. 1 and 4 (sec. IV-A, V-D); other tasks get the curves of score and
// length, and mazes the paths through them.
//
// Reads from each folder:  settings            lines `name = value    # source`; task, method, preset, seed are needed
//                          progress.csv        one row per evaluation, the first at the end of the offline phase
//                          episodes.csv        one row per online episode (not for DT)
//                          finished            an empty file; without it the logs above count as far as they go
//   mazes, if it is there: paths.csv           one row per state of the latest evaluation's episodes
//   finished grid worlds:  policy.csv          probability of each move in each cell
//                          start_actions.csv   share of each move at S: learned, D_offline, D_online (not for DT)
// Promises: every number comes from these files or stands in a column marked as the paper's; equal folders give equal
// bytes; seeds are averaged only if nothing but the seed was set differently, and the physics were the same; errors
// name file and line.
// Leaves out: networks, statistics beyond mean and standard deviation, judging whether a difference matters.
#pragma once

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <filesystem>
#include <iterator>
#include <limits>
#include <map>
#include <string>
#include <string_view>
#include <system_error>
#include <tuple>
#include <utility>
#include <vector>

#include "../gridworld.hpp"
#include "../mujoco_env.hpp"
#include "figures.hpp"
#include "safetensors.hpp"

// ---------------------------------------------------------------------------------------------------------------------
// Settings

struct Setting {
    std::string name, value;
    std::string source;  // "command line": a repetition must give it again
};

inline std::string trimmed(std::string_view text) {
    const size_t first = text.find_first_not_of(" \t");
    if (first == std::string_view::npos) return "";
    return std::string(text.substr(first, text.find_last_not_of(" \t") + 1 - first));
}

// Empty lines and lines that start with # are skipped. The first " = " ends a name, the first " # " after it a value.
inline std::vector<Setting> parse_settings(std::string_view text, const std::string& path) {
    std::vector<Setting> out;
    for (size_t line = 1; !text.empty(); ++line) {
        const std::string_view all = text.substr(0, text.find('\n'));
        text.remove_prefix(std::min(text.size(), all.size() + 1));
        if (trimmed(all).empty() || trimmed(all)[0] == '#') continue;
        const size_t equals = all.find(" = "), hash = all.find(" # ", equals);  // npos stays npos
        Setting setting;
        if (hash != std::string_view::npos)
            setting = {trimmed(all.substr(0, equals)), trimmed(all.substr(equals + 2, hash - equals - 2)),
                       trimmed(all.substr(hash + 2))};
        if (setting.name.empty() || setting.value.empty() || setting.source.empty())
            fail("settings.line", "%s: line %zu: expected \"name = value    # source\", got \"%s\"", path.c_str(), line,
                 trimmed(all).c_str());
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

struct Method {
    const char* label;
    Colour colour;
    const char* paper_length;  // what the paper says of the grid world's final length
    const char* start_figure;  // the paper's figure of the actions at S
};
constexpr std::array<const char*, 3> method_names{"dt", "odt", "wodtem"};
constexpr std::array<Method, 3> methods{{
    {"DT", Colour::green, "no number (fig. 4a)", ""},
    {"ODT", Colour::blue, "about 7 (sec. IV-A)", "1d"},
    {"WODTEM", Colour::vermillion, "5 (sec. V-D)", "4b"},
}};

using MoveShares = std::array<double, grid_moves>;

struct MazeEpisode {
    double goal_x, goal_y;     // m, like x and y
    std::vector<double> x, y;  // observed, from the first state to the last
};

struct Run {
    std::string folder;
    std::vector<Setting> settings;
    std::string task, preset;
    size_t method = 0;  // in method_names
    int64_t seed = 0;
    const MujocoTask* mujoco_task = nullptr;  // null: the grid world, or a task of which we know the name alone
    Physics physics = Physics::d4rl;          // with mujoco_task alone, like the next
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

inline std::string setting_or(const Run& run, const std::string& name, const std::string& otherwise) {
    for (const Setting& setting : run.settings)
        if (setting.name == name) return setting.value;
    return otherwise;
}

// It becomes part of titles, commands and file names.
inline std::string needed_word(const Run& run, const std::string& name) {
    const std::string value = setting_or(run, name, "");
    if (value.empty() || value.find_first_not_of("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789-._") !=
                             std::string::npos)
        fail("report.setting", "%s/settings: %s is \"%s\", expected a word of letters, digits and -._",
             run.folder.c_str(), name.c_str(), value.c_str());
    return value;
}

template <size_t N>
size_t choice(const Run& run, const char* name, const std::string& value, const std::array<const char*, N>& names) {
    const auto found = std::find(names.begin(), names.end(), value);
    std::string known;
    for (const char* one : names) known += std::string(" ") + one;
    if (found == names.end())
        fail("report.setting", "%s/settings: %s is \"%s\", expected one of%s", run.folder.c_str(), name, value.c_str(),
             known.c_str());
    return static_cast<size_t>(found - names.begin());
}

inline EdgeRule edge_of(const Run& run) {
    return static_cast<EdgeRule>(choice(run, "edge", setting_or(run, "edge", "clipped"), edge_rule_names));
}

// A column without NaN, all values in [low, high].
inline std::vector<double> numbers_within(const Table& table, const std::string& column, const std::string& path,
                                          double low, double high) {
    const std::vector<double> out = numbers(table, column, path);
    for (size_t i = 0; i < out.size(); ++i)
        if (!(out[i] >= low && out[i] <= high))
            fail("report.range", "%s: line %zu: column \"%s\" holds %g, expected %g to %g", path.c_str(), i + 2,
                 column.c_str(), out[i], low, high);
    return out;
}

inline std::vector<double> rising_interactions(const Table& table, const std::string& path) {
    const std::vector<double> out = numbers_within(table, "interactions", path, 0, 1e15);
    for (size_t i = 1; i < out.size(); ++i)
        if (out[i] < out[i - 1])
            fail("report.order", "%s: line %zu: the interactions fall from %.0f to %.0f", path.c_str(), i + 2,
                 out[i - 1], out[i]);
    return out;
}

// The rows must be the cells, or the moves, in order: `first` has the fields that each begins with.
inline void check_rows(const Table& table, const std::vector<std::vector<std::string>>& first,
                       const std::string& path) {
    for (size_t i = 0; i < std::max(first.size(), table.rows.size()); ++i)
        if (i >= first.size() || i >= table.rows.size() || table.rows[i].size() < first[i].size() ||
            !std::equal(first[i].begin(), first[i].end(), table.rows[i].begin()))
            fail("report.rows", "%s: line %zu: expected %zu rows below the header, in order of cells or moves",
                 path.c_str(), i + 2, first.size());
}

inline std::vector<MoveShares> read_policy(const std::string& path) {
    const Table table = parse_csv(read_file(path), path);
    std::vector<std::vector<std::string>> cells;
    for (int cell = 0; cell < grid_cells; ++cell)
        cells.push_back({std::to_string(cell / grid_size), std::to_string(cell % grid_size)});
    check_rows(table, cells, path);
    std::vector<MoveShares> out(grid_cells);
    for (size_t move = 0; move < grid_moves; ++move) {
        const std::vector<double> column = numbers_within(table, grid_move_table[move].name, path, 0, 1);
        for (size_t cell = 0; cell < grid_cells; ++cell) out[cell][move] = column[cell];
    }
    return out;
}

inline std::array<std::vector<double>, 3> read_start_actions(const std::string& path) {
    const Table table = parse_csv(read_file(path), path);
    std::vector<std::vector<std::string>> moves;
    for (const GridMove& move : grid_move_table) moves.push_back({move.name});
    check_rows(table, moves, path);
    return {numbers_within(table, "learned", path, 0, 1), numbers_within(table, "offline", path, 0, 1),
            numbers(table, "online", path)};  // NaN if the online phase had no budget
}

// Within the map, or beside it by less than its own size. NaN is nowhere.
inline bool near_maze(const MujocoTask& task, double x, double y) {
    const std::string_view map = task.maze;
    const auto rows = static_cast<double>(std::count(map.begin(), map.end(), '/'));
    const auto columns = static_cast<double>(map.find('/'));
    const MazePlace place = maze_place(task, x, y);
    return place.row > -rows && place.row < 2 * rows && place.column > -columns && place.column < 2 * columns;
}

// Episodes count from 0, and in each of them its steps; its goal stays.
inline std::vector<MazeEpisode> read_paths(const MujocoTask& task, const std::string& path) {
    const Table table = parse_csv(read_file(path), path);
    const std::vector<double> episode = numbers(table, "episode", path), goal_x = numbers(table, "goal_x", path),
                              goal_y = numbers(table, "goal_y", path), x = numbers(table, "x", path),
                              y = numbers(table, "y", path),
                              step = numbers_within(table, "step", path, 0, task.max_episode_steps);
    std::vector<MazeEpisode> out;
    for (size_t i = 0; i < step.size(); ++i) {
        if (step[i] == 0) out.push_back({goal_x[i], goal_y[i], {}, {}});
        if (out.empty() || episode[i] != static_cast<double>(out.size() - 1) ||
            step[i] != static_cast<double>(out.back().x.size()))
            fail("report.order",
                 "%s: line %zu: episode %g, step %g does not follow from the line before; both count up from 0",
                 path.c_str(), i + 2, episode[i], step[i]);
        for (const auto& [what, at_x, at_y] : {std::tuple("goal", goal_x[i], goal_y[i]), {"position", x[i], y[i]}})
            if (!near_maze(task, at_x, at_y))
                fail("report.range",
                     "%s: line %zu: the %s (%g, %g) is nowhere near the maze of %s; remove the file to report without "
                     "it",
                     path.c_str(), i + 2, what, at_x, at_y, task.name);
        if (goal_x[i] != out.back().goal_x || goal_y[i] != out.back().goal_y)
            fail("report.goal", "%s: line %zu: the goal is not that of the episode's first line", path.c_str(), i + 2);
        out.back().x.push_back(x[i]), out.back().y.push_back(y[i]);
    }
    return out;
}

// A run that has just begun may not have its logs yet.
inline Table read_log(const Run& run, const std::string& path, const char* header) {
    return parse_csv(run.finished || std::filesystem::exists(path) ? read_file(path) : header, path);
}

inline void read_logs(Run& run) {
    const std::string evaluations = run.folder + "/progress.csv", episodes = run.folder + "/episodes.csv";
    const Table progress = read_log(run, evaluations, "interactions,eval_length,eval_return,eval_score\n");
    run.interactions = rising_interactions(progress, evaluations);
    run.length = numbers(progress, "eval_length", evaluations);
    run.total = numbers(progress, "eval_return", evaluations);
    run.score = numbers(progress, "eval_score", evaluations);
    if (!run.interactions.empty()) run.so_far = run.interactions.back();
    if (run.offline_only()) return;
    const Table met = read_log(run, episodes, "interactions,length,return\n");
    const std::vector<double> at = rising_interactions(met, episodes);
    run.episode_length = numbers_within(met, "length", episodes, 1, run.task == "gridworld" ? grid_max_steps : 1e9);
    run.episode_return = numbers(met, "return", episodes);
    if (!at.empty()) run.so_far = std::max(run.so_far, at.back());
}

inline Run read_run(const std::string& folder) {
    Run run;
    run.folder = folder;
    const std::string path = folder + "/settings";
    if (!std::filesystem::exists(path))
        fail("report.folder", "%s: is no run folder: it has no file `settings`, which training writes first",
             folder.c_str());
    run.settings = parse_settings(read_file(path), path);
    run.task = needed_word(run, "task"), run.preset = needed_word(run, "preset");
    run.method = choice(run, "method", needed_word(run, "method"), method_names);
    const std::string seed = needed_word(run, "seed");
    const auto [end, error] = std::from_chars(seed.data(), seed.data() + seed.size(), run.seed);
    if (error != std::errc() || end != seed.data() + seed.size())
        fail("report.setting", "%s: seed is \"%s\", expected a whole number", path.c_str(), seed.c_str());
    run.finished = std::filesystem::exists(folder + "/finished");
    run.mujoco_task = find_mujoco_task(run.task);
    if (run.mujoco_task) {
        run.physics = static_cast<Physics>(choice(run, "physics", needed_word(run, "physics"), physics_names));
        run.mujoco_version = needed_word(run, "mujoco");
        const std::string paths = folder + "/paths.csv";  // missing in a run that has just begun
        if (run.mujoco_task->maze && std::filesystem::exists(paths)) run.paths = read_paths(*run.mujoco_task, paths);
    }
    read_logs(run);
    if (run.task != "gridworld" || !run.finished) return run;
    run.policy = read_policy(folder + "/policy.csv");
    if (!run.offline_only()) run.start_actions = read_start_actions(folder + "/start_actions.csv");
    return run;
}

// ---------------------------------------------------------------------------------------------------------------------
// From runs to numbers. NaN: there is none.

constexpr double none = std::numeric_limits<double>::quiet_NaN();

struct Spread {
    size_t count = 0;         // of values that are not NaN
    double mean = none;       // of these
    double deviation = none;  // standard deviation with count - 1
};

inline Spread spread_of(std::vector<double> values) {
    std::erase_if(values, [](double value) { return std::isnan(value); });
    Spread out{values.size(), none, none};
    const double n = static_cast<double>(values.size());
    double sum = 0, squares = 0;
    for (const double value : values) sum += value;
    if (n > 0) out.mean = sum / n;
    for (const double value : values) squares += (value - out.mean) * (value - out.mean);
    if (n > 1) out.deviation = std::sqrt(squares / (n - 1));
    return out;
}

// Entry i over all rows, which are of equal size: one row per run. No band or stroke for a single run.
template <class Rows>
void fill_spread(std::vector<double>& mean, std::vector<double>& deviation, const Rows& rows) {
    for (size_t i = 0; i < rows.at(0).size(); ++i) {
        std::vector<double> values;
        for (const std::vector<double>& row : rows) values.push_back(row[i]);
        mean.push_back(spread_of(values).mean);
        if (rows.size() > 1) deviation.push_back(spread_of(values).deviation);
    }
}

// The last y that is not NaN and whose x, which does not fall, is not above `at`.
inline double last_until(const std::vector<double>& x, const std::vector<double>& y, double at) {
    double out = none;
    for (size_t i = 0; i < x.size() && x[i] <= at; ++i)
        if (!std::isnan(y[i])) out = y[i];
    return out;
}
inline double final_value(const Run& run, Quantity quantity) {
    return last_until(run.interactions, run.*quantity, 1e15);
}

// Mean over the last ten evaluations (or all, if there are fewer): one evaluation of a policy that wavers says little.
inline double last_ten(const Run& run, Quantity quantity) {
    const std::vector<double>& y = run.*quantity;
    double sum = 0, count = 0;
    for (size_t i = y.size(); i-- > 0 && count < 10;)
        if (!std::isnan(y[i])) sum += y[i], ++count;
    return count > 0 ? sum / count : none;
}

// Seeds are evaluated at different interactions, so all are drawn at 0, 250, 500, ... up to the largest of any run; long
// runs in larger steps, at most about 400.
inline std::vector<double> curve_points(const Runs& runs) {
    double largest = 0;
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
        const bool last = run.finished && at == points.back(), over = !run.finished && at > run.so_far;
        out.push_back(over   ? none
                      : last ? final_value(run, quantity)
                             : last_until(run.interactions, run.*quantity, at));
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

inline std::string bin_label(size_t bin) {
    const int first = bin == 0 ? 5 : bin_ends[bin - 1] + 1, last = bin_ends[bin];
    return (bin == 0 ? "≤ " : "") + std::to_string(first) + (first < last ? "–" + std::to_string(last) : "");
}

inline std::vector<double> count_lengths(const std::vector<double>& lengths) {
    std::vector<double> out(bin_ends.size(), 0);
    for (const double length : lengths)
        out[static_cast<size_t>(std::lower_bound(bin_ends.begin(), bin_ends.end() - 1, length) - bin_ends.begin())] +=
            1;
    return out;
}

// Of equally likely moves the first.
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

inline std::string shown(double value, int decimals) {
    if (value == 0 && decimals == 2) return "0.00";  // an axis would say 0
    return std::isnan(value) ? "-" : svg::tick_text(value, decimals);
}

// "5.00 ± 0.00"; "5.00 ± -" for one value; "-" for none.
inline std::string plus_minus(const Spread& spread) {
    return spread.count == 0 ? "-" : shown(spread.mean, 2) + " ± " + shown(spread.deviation, 2);
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
inline std::string who(const Runs& runs) {
    std::string out = runs.at(0)->about_method().label, before = runs.size() > 1 ? " seeds " : " seed ";
    for (const auto& [first, last] : seed_ranges(runs)) {
        out += before + std::to_string(first) + (first < last ? "–" + std::to_string(last) : "");
        before = ", ";
    }
    return out;
}
inline std::string who(const std::vector<Runs>& by_method) {
    std::string out;
    for (const Runs& runs : by_method) out += (out.empty() ? "" : "; ") + who(runs);
    return out;
}

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

// What the command line set beyond task, method, preset, seed and physics: " --set width=64".
inline std::string other_options(const Run& run) {
    std::string out;
    for (const auto& [name, value, source] : run.settings) {
        const bool named =
            name == "task" || name == "method" || name == "preset" || name == "seed" || name == "physics";
        if (source == "command line" && !named) out += " --set " + name + "=" + value;
    }
    return out;
}

// "physics d4rl on MuJoCo 2.2.2"
inline std::string physics_of(const Run& run) {
    return std::string("physics ") + physics_names[static_cast<size_t>(run.physics)] + " on MuJoCo " +
           run.mujoco_version;
}

// "20,050"; "20,050–20,712" if they differ.
inline std::string range_text(const std::vector<double>& values) {
    const auto [low, high] = std::minmax_element(values.begin(), values.end());
    return shown(*low, 0) + (*low < *high ? "–" + shown(*high, 0) : "");
}

// For a terminal: columns aligned to the right, the first to the left. Widths count characters, not bytes.
inline std::string text_table(const Table& table) {
    const auto characters = [](const std::string& text) {
        return static_cast<size_t>(std::count_if(text.begin(), text.end(), [](char c) { return (c & 0xC0) != 0x80; }));
    };
    std::vector<std::vector<std::string>> rows = table.rows;
    rows.insert(rows.begin(), table.header);
    std::vector<std::string> lines(rows.size());
    for (size_t column = 0; column < table.header.size(); ++column) {
        size_t widest = 0;
        for (const auto& row : rows) widest = std::max(widest, characters(row[column]));
        for (size_t i = 0; i < rows.size(); ++i) {
            const std::string space(widest - characters(rows[i][column]), ' ');
            lines[i] += column == 0 ? rows[i][0] + space : "  " + space + rows[i][column];
        }
    }
    std::string out;
    for (const std::string& line : lines) out += line + "\n";
    return out;
}

// ---------------------------------------------------------------------------------------------------------------------
// Figures and tables of one task and preset

struct Part {
    Section section;
    std::vector<std::string> files;  // of the section's figures
};

inline void add_figure(Part& part, const std::string& file, const std::string& figure, const std::string& caption) {
    part.section.figures.push_back({figure, caption});
    part.files.push_back(file + ".svg");
}

inline LineChart mean_chart(const std::vector<Runs>& by_method, Quantity quantity) {
    Runs all;
    for (const Runs& runs : by_method) all.insert(all.end(), runs.begin(), runs.end());
    LineChart chart;
    chart.x_label = "online interactions";
    for (const Runs& runs : by_method) {
        Series series{runs[0]->about_method().label, runs[0]->about_method().colour, curve_points(all), {}, {}};
        std::vector<std::vector<double>> rows;
        for (const Run* run : runs) rows.push_back(resampled(*run, quantity, series.x));
        fill_spread(series.mean, series.deviation, rows);
        if (!runs[0]->offline_only())
            chart.series.push_back(series);
        else if (!std::isnan(series.mean[0]))  // no online phase: a line across, as in fig. 4a
            chart.references.push_back({series.label, series.colour, series.mean[0]});
    }
    return chart;
}

inline std::string curve_caption(const std::vector<Runs>& by_method) {
    const bool dt = by_method.at(0)[0]->offline_only();
    return who(by_method) +
           ". Lines: mean over seeds; bands: one standard deviation to either side, none for one seed." +
           (dt ? " DT has no online phase and is the dashed line, its mean over seeds." : "") +
           " Seeds are evaluated at different interactions; drawn at equal steps (of 250 interactions in a short run), each "
           "seed by its last evaluation until then, and at the last point by its final one." +
           if_unfinished(by_method,
                         " Unfinished seeds count up to their own last interactions, so that a line may jump where one "
                         "of them ends.");
}

// Figs. 1b, 4a
inline void add_length_curve(Part& part, const std::vector<Runs>& by_method, const std::string& name) {
    LineChart chart = mean_chart(by_method, &Run::length);
    chart.title = "Evaluation length during online training";
    chart.y_label = "evaluation length, steps (log scale)";
    chart.references.push_back({"shortest path, 5 steps", Colour::black, 5});
    chart.log_y = true, chart.y_floor = 5;
    add_figure(part, name + "-length", line_chart(chart),
               "Compare with figs. 1b and 4a of the paper. " + curve_caption(by_method) +
                   " An episode ends at the goal or after 100 steps.");
}

// Fig. 1c
inline void add_histogram(Part& part, const std::vector<Runs>& by_method, const std::string& name) {
    BarChart chart{
        "Lengths of the online episodes", "episode length, steps", "mean number of episodes per seed", {}, {}};
    for (size_t bin = 0; bin < bin_ends.size(); ++bin) chart.categories.push_back(bin_label(bin));
    for (const Runs& runs : by_method) {
        std::vector<std::vector<double>> rows;
        for (const Run* run : runs) rows.push_back(count_lengths(run->episode_length));
        Bars& bars = chart.series.emplace_back(runs[0]->about_method().label, runs[0]->about_method().colour);
        fill_spread(bars.values, bars.deviation, rows);
    }
    add_figure(
        part, name + "-episodes", bar_chart(chart),
        "Compare with fig. 1c of the paper. " + who(by_method) +
            ". How many of the episodes met in online training had which length; from 11 on a bar covers a range "
            "of lengths, and 100 is the time limit. Bars: mean over seeds; strokes: one standard deviation to "
            "either side." +
            if_unfinished(by_method, " Unfinished seeds count with their episodes so far."));
}

// Figs. 1d, 4b; of finished runs.
inline void add_start_actions(Part& part, const Runs& runs, const std::string& name) {
    const Method& method = runs[0]->about_method();
    BarChart chart{std::string("Actions at S: ") + method.label, "move", "share", {}, {}};
    for (const GridMove& move : grid_move_table) chart.categories.emplace_back(move.name);
    chart.series = {{"learned policy", method.colour, {}, {}},
                    {"D_offline", Colour::sky, {}, {}},
                    {"D_online", Colour::purple, {}, {}}};
    for (size_t k = 0; k < 3; ++k) {
        std::vector<std::vector<double>> rows;
        for (const Run* run : runs) rows.push_back(run->start_actions[k]);
        fill_spread(chart.series[k].values, chart.series[k].deviation, rows);
    }
    add_figure(part, name + "-start-" + method_names[runs[0]->method], bar_chart(chart),
               std::string("Compare with fig. ") + method.start_figure + " of the paper. " + who(runs) +
                   ", finished. Share of each move at the start cell S: its probability under the learned policy, and "
                   "its frequency in D_offline and, at the end, in D_online. Bars: mean over seeds; strokes: one "
                   "standard deviation to either side. R, D, L, U: right, down, left, up.");
}

// Fig. 1a shows the shortest path in this way; the paper does not show a learned one.
inline void add_grid(Part& part, const Run& run, const std::string& name) {
    const std::vector<int> path = greedy_path(run.policy, edge_of(run));
    const auto cell_at = [](int cell) { return Cell{cell / grid_size, cell % grid_size}; };
    GridPolicy grid{
        "Learned policy: " + who(Runs{&run}), grid_size, grid_size, {}, cell_at(grid_start), cell_at(grid_goal), {}};
    for (const MoveShares& shares : run.policy) {
        const GridMove& move = grid_move_table[most_likely(shares)];
        grid.arrows.push_back({move.row_change, move.column_change, shares[most_likely(shares)]});
    }
    grid.arrows[grid_goal] = {0, 0, 0};  // no move is made there
    for (const int cell : path) grid.path.push_back(cell_at(cell));
    const std::string steps = std::to_string(path.size() - 1) + (path.size() == 2 ? " step" : " steps");
    add_figure(part, name + "-grid-" + method_names[run.method], grid_policy(grid),
               "Compare the blue cells with fig. 1a of the paper. " + who(Runs{&run}) +
                   ", finished. Arrows: the most likely move in each cell; blue: the cells that these moves visit from "
                   "S on. " +
                   (path.back() == grid_goal
                        ? "They reach G in " + steps + "."
                        : "They do not reach G: after " + steps + " the next move leads to a cell visited before.") +
                   " Moves off the grid: " + edge_rule_names[static_cast<size_t>(edge_of(run))] + ".");
}

inline void add_gridworld(Part& part, const std::vector<Runs>& by_method, const std::string& name) {
    Table summary{{"Method", "Seeds", "Final length", "Mean of last 10", "Final return", "Ends at 5", "Paper: length"},
                  {}};
    Table seeds{{"Run", "State", "Final length", "Last 10", "Final return", "Shortest met", "At 5 from", "Folder"}, {}};
    std::vector<Runs> online;
    for (const Runs& runs : by_method) {
        std::vector<double> length, ten, total;
        size_t at_five = 0;
        for (const Run* run : runs) {
            length.push_back(final_value(*run, &Run::length)), total.push_back(final_value(*run, &Run::total));
            ten.push_back(last_ten(*run, &Run::length));
            const double from = kept_from(*run, 5);
            at_five += std::isnan(from) ? 0 : 1;
            seeds.rows.push_back(
                {who(Runs{run}), run->finished ? "finished" : "unfinished, at " + shown(run->so_far, 0),
                 shown(length.back(), 2), shown(ten.back(), 2), shown(total.back(), 2), shown(shortest_met(*run), 0),
                 run->length.empty() ? "-"
                 : std::isnan(from)  ? "never"
                                     : shown(from, 0),
                 run->folder});
        }
        summary.rows.push_back({runs[0]->about_method().label, seed_count(runs), plus_minus(spread_of(length)),
                                plus_minus(spread_of(ten)), plus_minus(spread_of(total)),
                                std::to_string(at_five) + " of " + std::to_string(runs.size()),
                                runs[0]->about_method().paper_length});
        if (!runs[0]->offline_only()) online.push_back(runs);
    }
    part.section.tables = {summary, seeds};
    part.section.paragraphs.push_back(
        "Final: by the last evaluation of a run; mean of last 10: over its last ten evaluations; lengths in steps. Shortest met: the shortest online episode that "
        "reached the goal. At 5 from: the online interactions of the first evaluation from which on every one took 5 "
        "steps, the length of the shortest path (0: from the end of offline training on).");

    add_length_curve(part, by_method, name);
    if (!online.empty()) add_histogram(part, online, name);
    for (const Runs& runs : online)
        if (const Runs finished = only_finished(runs); !finished.empty()) add_start_actions(part, finished, name);
    for (const Runs& runs : by_method)
        if (const Runs finished = only_finished(runs); !finished.empty()) add_grid(part, *finished[0], name);
}

inline bool ends_early(const MujocoTask& task) {
    return task.rules != Rules::maze2d && task.rules != Rules::halfcheetah;
}

// What a section's numbers rest on.
inline std::string about_physics(const Run& run) {
    const MujocoTask& task = *run.mujoco_task;
    const std::string limit = shown(task.max_episode_steps, 0) + " steps.";
    return "All runs: " + physics_of(run) + ", masses and inertias as " +
           (run.physics == Physics::d4rl ? "in MuJoCo up to 2.1.0, which made D4RL's data"
                                         : "MuJoCo 2.2 computes them from the geometry") +
           ". Score 0 is a mean return of " + shown(task.score_low, 2) + ", score 100 one of " +
           shown(task.score_high, 2) + ". " +
           (task.rules == Rules::antmaze ? "An episode ends at the goal, or after "
            : ends_early(task)           ? "An episode ends when the body leaves gym's healthy range, or after "
                                         : "Every episode takes ") +
           limit;
}

inline bool reached_goal(const MazeEpisode& episode) {
    bool reached = false;
    for (size_t t = 0; t < episode.x.size(); ++t)
        reached = reached || std::hypot(episode.x[t] - episode.goal_x, episode.y[t] - episode.goal_y) <= goal_radius;
    return reached;
}

constexpr size_t paths_drawn = 10;  // at most; more would hide each other

inline MazePaths paths_on_map(const Run& run) {
    const MujocoTask& task = *run.mujoco_task;
    const auto place = [&](double x, double y) {
        const MazePlace at = maze_place(task, x, y);
        return Place{at.row, at.column};
    };
    MazePaths maze{run.task + ": paths of " + who(Runs{&run}),
                   task.maze,
                   goal_radius / maze_cell_length(task),
                   "goal (radius " + svg::number(goal_radius) + " m)",
                   {}};
    for (size_t i = 0; i < std::min(run.paths.size(), paths_drawn); ++i) {
        const MazeEpisode& episode = run.paths[i];
        MazePath& path = maze.paths.emplace_back(place(episode.goal_x, episode.goal_y), std::vector<Place>{});
        for (size_t t = 0; t < episode.x.size(); ++t) path.places.push_back(place(episode.x[t], episode.y[t]));
    }
    return maze;
}

// The latest evaluation of one run, in a maze.
inline void add_paths(Part& part, const Run& run, const std::string& name) {
    const bool ant = run.mujoco_task->rules == Rules::antmaze;
    const auto reached = std::count_if(run.paths.begin(), run.paths.end(), reached_goal);
    std::string caption = who(Runs{&run}) + (run.finished ? "" : ", unfinished") + ": its latest evaluation";
    if (!run.interactions.empty()) caption += ", at " + shown(run.interactions.back(), 0) + " online interactions";
    caption += ", " + physics_of(run) + ". " + std::to_string(reached) + " of " + std::to_string(run.paths.size()) +
               " episodes came within " + svg::number(goal_radius) + " m of the goal" +
               (ant ? ", which ended them; each has a goal of its own, circled in its colour."
                    : " at some time. None ends there: the score counts the steps within that distance.");
    if (run.paths.size() > paths_drawn) caption += " The first " + std::to_string(paths_drawn) + " are drawn.";
    caption += std::string(" The maze as its map is printed, walls grey; x runs ") +
               (ant ? "to the right and y downwards." : "downwards and y to the right.");
    add_figure(part, name + "-paths-" + method_names[run.method], maze_paths(paths_on_map(run)), caption);
}

inline Table score_table(const std::vector<Runs>& by_method) {
    Table table{{"Method", "Seeds", "Final normalised score", "Mean of last 10 scores", "Final return", "Final length",
                 "Interactions"},
                {}};
    for (const Runs& runs : by_method) {
        std::vector<double> score, ten, total, length, interactions;
        for (const Run* run : runs) {
            score.push_back(final_value(*run, &Run::score)), ten.push_back(last_ten(*run, &Run::score));
            total.push_back(final_value(*run, &Run::total)), length.push_back(final_value(*run, &Run::length));
            interactions.push_back(run->so_far);
        }
        table.rows.push_back({runs[0]->about_method().label, seed_count(runs), plus_minus(spread_of(score)),
                              plus_minus(spread_of(ten)), plus_minus(spread_of(total)), plus_minus(spread_of(length)),
                              range_text(interactions)});
    }
    return table;
}

// Any other task: scores where the runs have them, else returns.
inline void add_other_task(Part& part, const std::vector<Runs>& by_method, const std::string& name) {
    const Run& any = *by_method.at(0)[0];
    bool scored = false;
    for (const Runs& runs : by_method)
        for (const Run* run : runs) scored = scored || !std::isnan(final_value(*run, &Run::score));
    part.section.tables.push_back(score_table(by_method));
    if (any.mujoco_task) part.section.paragraphs.push_back(about_physics(any));
    const std::string physics = any.mujoco_task ? " Runs with " + physics_of(any) + "." : "";

    LineChart score = mean_chart(by_method, scored ? &Run::score : &Run::total);
    score.title = any.task + (scored ? ": normalised score" : ": return");
    score.cut_x = true;  // the last episode may overrun a round budget
    score.y_label = scored ? "normalised score" : "return";
    add_figure(part, name + "-curve", line_chart(score),
               curve_caption(by_method) +
                   (any.mujoco_task && scored ? " Score 0: a random policy; 100: an expert." : "") + physics);
    if (!any.mujoco_task || ends_early(*any.mujoco_task)) {  // else a flat line
        LineChart length = mean_chart(by_method, &Run::length);
        length.title = any.task + ": evaluation length";
        length.cut_x = true;
        length.y_label = "evaluation length, steps";
        add_figure(part, name + "-length", line_chart(length),
                   who(by_method) + ". Lines and bands as in the figure before." + physics);
    }

    for (const Runs& runs : by_method) {
        const auto with_paths =
            std::find_if(runs.begin(), runs.end(), [](const Run* run) { return !run->paths.empty(); });
        if (with_paths != runs.end()) add_paths(part, **with_paths, name);
    }
}

// A mean over seeds needs each seed once and nothing else different.
inline void check_seeds(const Runs& runs) {
    for (size_t i = 1; i < runs.size(); ++i) {
        const Run &a = *runs[i - 1], &b = *runs[i];
        if (a.seed == b.seed)
            fail("report.same_seed", "%s and %s are the same method with the same seed; give only one of them",
                 a.folder.c_str(), b.folder.c_str());
        if (other_options(a) != other_options(b))
            fail("report.options", "%s was run with \"%s\" and %s with \"%s\"; report them apart", a.folder.c_str(),
                 trimmed(other_options(a)).c_str(), b.folder.c_str(), trimmed(other_options(b)).c_str());
    }
}

// In a section, since versions of the library may differ in every digit.
inline void check_mujoco(const Runs& runs) {
    for (const Run* run : runs)
        if (run->mujoco_version != runs[0]->mujoco_version)
            fail("report.mujoco", "%s was run on MuJoCo %s and %s on MuJoCo %s; report them apart",
                 runs[0]->folder.c_str(), runs[0]->mujoco_version.c_str(), run->folder.c_str(),
                 run->mujoco_version.c_str());
}

// The commands that made the runs, one for each unbroken range of seeds.
inline Table repeat_table(const std::vector<Runs>& by_method) {
    Table table{{"To repeat these runs", "Arithmetic"}, {}};
    for (const Runs& runs : by_method) {
        std::string arithmetic;  // each seed's
        for (const Run* run : runs) {
            const std::string one = setting_or(*run, "arithmetic", "not recorded");
            if (arithmetic.find(one) == std::string::npos) arithmetic += (arithmetic.empty() ? "" : ", ") + one;
        }
        const std::string physics =
            runs[0]->mujoco_task ? std::string(" --physics ") + physics_names[static_cast<size_t>(runs[0]->physics)]
                                 : "";
        for (const auto& [first, last] : seed_ranges(runs)) {
            const std::string seeds = first < last ? " --seeds " + std::to_string(first) + "-" + std::to_string(last)
                                                   : " --seed " + std::to_string(first);
            table.rows.push_back({"wodtem train " + runs[0]->task + " --method " + method_names[runs[0]->method] +
                                      " --preset " + runs[0]->preset + seeds + physics + other_options(*runs[0]),
                                  arithmetic});
        }
    }
    return table;
}

// `runs`: of one task, preset and physics, by method, then seed.
inline Part make_part(const Runs& runs) {
    std::vector<Runs> by_method;
    for (const Run* run : runs) {
        if (by_method.empty() || by_method.back()[0]->method != run->method) by_method.emplace_back();
        by_method.back().push_back(run);
    }
    for (const Runs& seeds : by_method) check_seeds(seeds);
    check_mujoco(runs);
    const std::string &task = runs.at(0)->task, &preset = runs[0]->preset;
    std::string name = task + "-" + preset;
    Part part;
    part.section.heading = task + ", preset " + preset;
    if (runs[0]->mujoco_task) {
        const std::string physics = physics_names[static_cast<size_t>(runs[0]->physics)];
        part.section.heading += ", physics " + physics;
        if (runs[0]->physics != Physics::d4rl) name += "-physics-" + physics;
    }
    (task == "gridworld" ? add_gridworld : add_other_task)(part, by_method, name);
    part.section.tables.push_back(repeat_table(by_method));
    return part;
}

inline std::string markdown_page(const std::string& title, const std::vector<Part>& parts) {
    std::string out = "# " + title + "\n";
    for (const Part& part : parts) {
        out += "\n## " + part.section.heading + "\n";
        for (const std::string& paragraph : part.section.paragraphs) out += "\n" + paragraph + "\n";
        for (const Table& table : part.section.tables) out += "\n" + markdown_table(table);
        for (size_t i = 0; i < part.files.size(); ++i)
            out += "\n![](" + part.files[i] + ")\n\n" + part.section.figures[i].caption + "\n";
    }
    return out;
}

inline const char* how_to_read =
    "One section for each task and preset. All numbers come from the run folders, except those in the column marked as "
    "the paper's. \"a ± b\": mean and standard deviation over seeds (n − 1; \"-\": one seed). A run that has not "
    "finished is marked so and counts with its latest evaluation. The last table has the commands that repeat the "
    "runs; the file settings in a run's folder has the value of every setting and where it came from.";
inline const char* how_to_read_scores =
    "Normalised score, as D4RL defines it: 0 for the return of a random policy, 100 for that of an expert, linear between "
    "and beyond; each section gives both returns. Final: by the last evaluation of a run; mean of last 10: over its last "
    "ten evaluations; an evaluation that came to nothing (nan in progress.csv) is passed over. Lengths are in steps. "
    "Interactions: online, of each run, from the least to the most. Runs with different physics stand in sections of "
    "their own and are never averaged.";

}  // namespace results

// Writes report.html, report.md and the figures into `out_folder`; returns the tables as text for a terminal.
inline std::string report(const std::vector<std::string>& folders, const std::string& out_folder) {
    using namespace results;
    if (folders.empty()) fail("report.nothing", "report: no run folder was given; give at least one");
    std::vector<Run> all;
    for (const std::string& folder : folders) all.push_back(read_run(folder));
    std::stable_sort(all.begin(), all.end(), [](const Run& a, const Run& b) {
        return std::tie(a.task, a.preset, a.method, a.seed) < std::tie(b.task, b.preset, b.method, b.seed);
    });
    std::map<std::tuple<std::string, std::string, Physics>, Runs> groups;
    for (const Run& run : all) groups[{run.task, run.preset, run.physics}].push_back(&run);
    std::vector<Part> parts = {{{"How to read this", {how_to_read}, {}, {}}, {}}};
    if (std::any_of(all.begin(), all.end(), [](const Run& run) { return run.mujoco_task != nullptr; }))
        parts[0].section.paragraphs.push_back(how_to_read_scores);
    for (const auto& group : groups) parts.push_back(make_part(group.second));

    std::error_code error;
    std::filesystem::create_directories(out_folder, error);
    if (error) fail("report.write", "%s: cannot make this folder: %s", out_folder.c_str(), error.message().c_str());
    std::string text;
    std::vector<Section> sections;
    for (const Part& part : parts) {
        sections.push_back(part.section);
        for (size_t i = 0; i < part.files.size(); ++i)
            write_file_atomic(out_folder + "/" + part.files[i], part.section.figures[i].svg);
        if (!part.section.tables.empty()) text += part.section.heading + "\n\n";
        for (const Table& table : part.section.tables) text += text_table(table) + "\n";
    }
    const std::string title = "WODTEM: report on " + std::to_string(all.size()) + (all.size() == 1 ? " run" : " runs");
    write_file_atomic(out_folder + "/report.html", html_page(title, sections));
    write_file_atomic(out_folder + "/report.md", markdown_page(title, parts));
    return text;
}
