// test_report.cpp: the report's numbers against sums done by hand, its errors by id, and one whole report of run
// folders written here.
#include <cstdlib>
#include <filesystem>

#include "../data/report.hpp"
#include "test.hpp"

namespace {

using namespace results;

// A folder of its own for each test, gone afterwards.
struct TemporaryFolder {
    std::string path = (std::filesystem::temp_directory_path() / "wodtem-report-XXXXXX").string();
    TemporaryFolder() {
        if (::mkdtemp(path.data()) == nullptr) fail("test.folder", "cannot make %s", path.c_str());
    }
    ~TemporaryFolder() { std::filesystem::remove_all(path); }
};

void write(const std::string& folder, const std::string& name, const std::string& text) {
    std::filesystem::create_directories(folder);
    write_file_atomic(folder + "/" + name, text);
}

// 36 rows: `move` with probability 0.65 in every cell, 0.05 for each of the seven others.
std::string policy_csv(const std::string& move) {
    std::string out = "row,column", shares;
    for (const GridMove& m : grid_move_table) {
        out += std::string(",") + m.name;
        shares += m.name == move ? ",0.65" : ",0.05";
    }
    out += "\n";
    for (int cell = 0; cell < 36; ++cell)
        out += std::to_string(cell / 6) + "," + std::to_string(cell % 6) + shares + "\n";
    return out;
}

std::string start_csv() {
    std::string out = "move,learned,offline,online\n";
    for (const GridMove& m : grid_move_table) out += std::string(m.name) + ",0.125,0.125,0.125\n";
    return out;
}

using Options = std::map<std::string, std::string>;

// The file `settings` as training writes it; `options`: what the command line set.
std::string settings_file(const std::string& task, const std::string& method, int seed, const Options& options) {
    Settings settings = default_settings(task, method, "paper");
    settings.seed = seed;
    for (const auto& [name, value] : options) set_from(settings, name, value, "command line");
    return settings_text(settings);
}

// A finished grid-world run with preset paper; each evaluation is {interactions, length}.
std::string write_run(const std::string& parent, const std::string& method, int seed,
                      const std::vector<std::pair<int, int>>& evaluations, const Options& options = {}) {
    const std::string folder = parent + "/" + method + "-" + std::to_string(seed);
    write(folder, "settings", settings_file("gridworld", method, seed, options));
    std::string progress = "interactions,eval_length,eval_return,eval_score\n";
    for (const auto& [at, length] : evaluations)
        progress += std::to_string(at) + "," + std::to_string(length) + (length < 100 ? ",1,1\n" : ",0,0\n");
    write(folder, "progress.csv", progress);
    write(folder, "episodes.csv",
          "episode,interactions,length,return,terminated,actions\n1,7,7,1,1,4000111\n2,107,100,0,0,\n3,113,6,1,1,\n");
    write(folder, "policy.csv", policy_csv(method == "odt" ? "R" : "R-D"));
    write(folder, "start_actions.csv", start_csv());
    write(folder, "finished", "");
    return folder;
}

struct Evaluated {
    int interactions;
    double length, total, score;
};

// What a MuJoCo task's settings say of the physics, the library and the data.
struct Origin {
    std::string physics = "d4rl", source = "chosen", mujoco = "2.2.2", dataset_source = "D4RL's published file";
    std::string dataset = "a.hdf5", sha256 = "0123456789abcdef", first_weights = "none";
};

// A finished run of a MuJoCo task with preset paper.
std::string write_mujoco_run(const std::string& parent, const std::string& task, const std::string& method, int seed,
                             const std::vector<Evaluated>& evaluations, const Origin& origin = {}) {
    const std::string folder = parent + "/" + task + "-" + method + "-" + std::to_string(seed);
    Settings settings = default_settings(task, method, "paper");
    settings.seed = seed;
    set_from(settings, "physics", origin.physics, origin.source);
    set_from(settings, "mujoco", origin.mujoco, "the library's version");
    set_from(settings, "dataset", origin.dataset, origin.dataset_source);
    set_from(settings, "dataset_sha256", origin.sha256, "of the file");
    set_from(settings, "first_weights", origin.first_weights, "SHA-256 of the model file");
    write(folder, "settings", settings_text(settings));
    std::string progress = "interactions,eval_length,eval_return,eval_score,physics\n";
    for (const Evaluated& e : evaluations)
        progress += std::to_string(e.interactions) + "," + std::to_string(e.length) + "," + std::to_string(e.total) +
                    "," + std::to_string(e.score) + ",d4rl on MuJoCo 2.2.2\n";
    write(folder, "progress.csv", progress);
    if (method != "dt")
        write(folder, "episodes.csv", "interactions,length,return,physics\n100,100,20,d4rl on MuJoCo 2.2.2\n");
    write(folder, "finished", "");
    return folder;
}

Run run_with(const std::vector<double>& interactions, const std::vector<double>& length, bool finished) {
    Run run;
    run.progress = {{"interactions", interactions}, {"eval_length", length}};
    run.finished = finished;
    run.so_far = interactions.back();
    return run;
}

bool equal(const std::vector<double>& got, const std::vector<double>& expected) {
    bool same = got.size() == expected.size();
    for (size_t i = 0; same && i < got.size(); ++i)
        same = got[i] == expected[i] || (std::isnan(got[i]) && std::isnan(expected[i]));
    return same;
}

// Several spaces become one, so that rows of aligned tables can be written here as they read.
std::string narrow(const std::string& text) {
    std::string out;
    for (const char c : text)
        if (out.empty() || c != ' ' || out.back() != ' ') out += c;
    return out;
}

size_t count(const std::string& text, const std::string& part) {
    size_t found = 0;
    for (size_t at = text.find(part); at != std::string::npos; at = text.find(part, at + 1)) ++found;
    return found;
}

#define CHECK_CONTAINS(text, part) \
    if (count(text, part) == 0) CHECK_EQUAL(std::string(part), "is not in " + (text))

}  // namespace

TEST(settings_lines_are_read_with_their_sources) {
    const std::vector<Setting> got = parse_settings(
        "# a comment\n\nalpha = 0.75    # WODTEM sec. V-D: eq. (7)\n"
        "set = a = b # c # d",
        "f");
    CHECK_EQUAL(got.size(), size_t{2});
    CHECK_EQUAL(got[0].name + "|" + got[0].value + "|" + got[0].source, "alpha|0.75|WODTEM sec. V-D: eq. (7)");
    CHECK_EQUAL(got[1].name + "|" + got[1].value + "|" + got[1].source, "set|a = b|c # d");
}

TEST(settings_lines_of_another_form_are_refused) {
    for (const char* bad :
         {"alpha 0.75 # x", "alpha = 0.75", "alpha = # x", " = 0.75 # x", "alpha = 0.75 # ", "alpha = 1#x"})
        CHECK_FAILS("settings.line", parse_settings(bad, "f"));
    CHECK_FAILS("settings.repeated", parse_settings("seed = 1 # a\nseed = 1 # a\n", "f"));
    try {
        parse_settings("a = 1 # x\n\nb\n", "the/path");
    } catch (const Error& error) {
        CHECK(std::string(error.what()).starts_with("the/path: line 3: "));
    }
}

TEST(spread_divides_by_one_less_than_the_count_and_passes_over_missing_values) {
    const Moments got = moments_of({2, none, 4, 4, 4, 5, 5, 7, 9});  // mean 5, squares 9 1 1 1 0 0 4 16: 32 / 7
    CHECK_EQUAL(got.count, 8.0);
    CHECK_CLOSE(got.mean(), 5, 0);
    CHECK_CLOSE(got.sample_deviation(), 2.138089935299395, 1e-15);
    CHECK_EQUAL(plus_minus(moments_of({5, 5})), "5.00 ± 0.00");
    CHECK_EQUAL(plus_minus(moments_of({5})), "5.00 ± -");
    CHECK_EQUAL(plus_minus(moments_of({none})), "-");
}

TEST(mean_of_last_ten_passes_over_missing_values) {
    CHECK_CLOSE(last_ten(run_with({0}, {90, 1, 2, 3, 4, 5, none, 6, 7, 8, 9, 10}, true), "eval_length"), 5.5, 1e-12);
    CHECK_CLOSE(last_ten(run_with({0}, {4, 6}, true), "eval_length"), 5, 0);
    CHECK(std::isnan(last_ten(run_with({0}, {none}, true), "eval_length")));
}

TEST(length_five_counts_from_the_evaluation_after_which_it_never_left) {
    CHECK_CLOSE(kept_from(run_with({0, 100, 200, 300, 400}, {9, 5, 6, 5, 5}, true), 5), 300, 0);
    CHECK_CLOSE(kept_from(run_with({0, 100}, {5, 5}, true), 5), 0, 0);
    CHECK(std::isnan(kept_from(run_with({0, 100, 200}, {5, 5, 6}, true), 5)));
    CHECK(std::isnan(kept_from(run_with({0, 100}, {5, none}, true), 5)));
}

TEST(the_shortest_path_is_one_that_reached_the_goal) {
    Run run;
    CHECK(std::isnan(shortest_met(run)));
    run.episode_length = {9, 4, 7, 8};
    run.episode_return = {1, 0, 1, 1};
    CHECK_EQUAL(shortest_met(run), 7.0);
}

TEST(each_length_falls_into_the_bar_whose_label_says_so) {
    std::vector<double> counts(bar_labels.size(), 0);
    for (int length = 1; length <= 100; ++length) {
        const std::vector<double> one = count_lengths({static_cast<double>(length)});
        size_t found = 0;
        for (size_t bin = 0; bin < one.size(); ++bin) {
            counts[bin] += one[bin];
            if (one[bin] != 1) continue;
            ++found;
            int first = 0, last = 0;  // read back from the label
            const int fields = std::sscanf(bar_labels[bin], "%d–%d", &first, &last);
            if (fields == 0) CHECK(std::string(bar_labels[bin]) == "≤ 5" && length <= 5);
            if (fields == 1) CHECK_EQUAL(length, first);
            if (fields == 2) CHECK(first <= length && length <= last);
        }
        CHECK_EQUAL(found, size_t{1});
    }
    CHECK(equal(counts, {5, 1, 1, 1, 1, 1, 5, 5, 10, 20, 49, 1}));
}

TEST(greedy_path_goes_to_the_goal_or_stops_at_a_loop) {
    const auto always = [](size_t move) {
        std::vector<MoveShares> policy(36, MoveShares{});
        for (MoveShares& shares : policy) shares[move] = 1;
        return policy;
    };
    CHECK(greedy_path(always(4), EdgeRule::clipped) == std::vector<int>({0, 7, 14, 21, 28, 35}));
    CHECK(greedy_path(always(0), EdgeRule::clipped) == std::vector<int>({0, 1, 2, 3, 4, 5}));  // stuck in the corner
    CHECK(greedy_path(always(0), EdgeRule::wraps) == std::vector<int>({0, 1, 2, 3, 4, 5}));    // back at S
    CHECK(greedy_path(always(7), EdgeRule::wraps) == std::vector<int>({0, 35}));

    // Right along the top, then right-down in the corner: clipping slides down the wall, the other rule stays.
    std::vector<MoveShares> wall = always(0);
    for (size_t row = 0; row < 6; ++row) wall[row * 6 + 5] = always(4)[0];
    CHECK(greedy_path(wall, EdgeRule::clipped) == std::vector<int>({0, 1, 2, 3, 4, 5, 11, 17, 23, 29, 35}));
    CHECK(greedy_path(wall, EdgeRule::stays) == std::vector<int>({0, 1, 2, 3, 4, 5}));
    CHECK_EQUAL(most_likely(MoveShares{0.2, 0.3, 0.3}), 1);
}

TEST(report_states_what_the_folders_hold) {
    const TemporaryFolder temporary;
    std::vector<std::string> folders;
    for (const int seed : {2, 0, 1})
        folders.push_back(
            write_run(temporary.path, "wodtem", seed, {{0, 9}, {900 + seed, 5}, {1100, 5}}, {{"alpha", "0.5"}}));
    folders.push_back(write_run(temporary.path, "odt", 4, {{0, 100}, {1100, 7}}));
    folders.push_back(write_run(temporary.path, "odt", 0, {{0, 100}, {500, 100}}));
    std::filesystem::remove(folders.back() + "/finished");
    folders.push_back(write_run(temporary.path, "dt", 0, {{0, 14}}));

    const std::string out = temporary.path + "/out", text = report(folders, out);
    const std::string page = read_file(out + "/report.html"), markdown = narrow(read_file(out + "/report.md"));
    const std::string gridworld = "| ./wodtem train gridworld --method ";
    for (const std::string& row : std::vector<std::string>{
             "| Method | Seeds | Final length | Mean of last 10 | Paper | Final return |",
             "| WODTEM (alpha=0.5) | 3 | 5.00 ± 0.00 | 6.33 ± 0.00 | 5 (sec. V-D) | 1.00 ± 0.00 |",
             "| ODT | 2 (1 unfinished) | 53.50 ± 65.76 | 76.75 ± 32.88 | about 7 (sec. IV-A) | 0.50 ± 0.71 |",
             "| DT | 1 | 14.00 ± - | 14.00 ± - | no number (fig. 4a) | 1.00 ± - |",
             "| Run | State | Interactions | Final length | Last 10 | Shortest met | At 5 from | Folder |",
             "| WODTEM (alpha=0.5) seed 2 | finished | 1,100 | 5.00 | 6.33 | 6 | 902 | " + folders[0] + " |",
             "| ODT seed 0 | unfinished | 500 | 100.00 | 100.00 | 6 | - | " + folders[4] + " |",
             gridworld + "wodtem --preset paper --seed 0 --set alpha=0.5 | fused |",
             gridworld + "odt --preset paper --seed 4 | fused |"}) {
        CHECK_CONTAINS(markdown, row);
        CHECK_CONTAINS(narrow(text), row);
    }
    for (const char* figure :
         {"length", "episodes", "start-odt", "start-wodtem", "grid-dt", "grid-odt", "grid-wodtem"}) {
        const std::string file = std::string("gridworld-paper-") + figure + ".svg",
                          svg_text = read_file(out + "/" + file);
        CHECK(page.find(svg_text) != std::string::npos);
        CHECK(markdown.find("![](" + file + ")") != std::string::npos);
        CHECK(svg_text.find("nan") == std::string::npos);
        CHECK_CONTAINS(svg_text, ">gridworld: ");
        CHECK_CONTAINS(svg_text, ">preset paper; ");
        CHECK_CONTAINS(svg_text, "n = ");
    }
    CHECK_CONTAINS(page, "<h1>WODTEM: report on 6 runs</h1>");
    CHECK_CONTAINS(page, "These moves reach G. Moves: 5. Moves off the grid: clipped.");
    CHECK_CONTAINS(page, "These moves do not reach G, but return to a visited cell. Moves: 5.");
    // The curve has three means, above the lines of three and two seeds, and the paper's marks of ODT and WODTEM; each
    // mean and mark has an entry in the legend.
    const std::string curve = read_file(out + "/gridworld-paper-length.svg");
    CHECK_EQUAL(count(curve, "stroke-width=\"2.5\""), size_t{3 + 3});  // in the legend too
    CHECK_EQUAL(count(curve, "stroke-opacity"), size_t{3 + 2});
    CHECK_EQUAL(count(curve, ">paper: "), size_t{2});
    CHECK_EQUAL(count(curve, "stroke-dasharray"), size_t{2});  // DT's, and in the legend
    CHECK_EQUAL(count(curve, ">DT<") + count(curve, ">ODT<") + count(curve, ">WODTEM (alpha=0.5)<"), size_t{3});
    CHECK_CONTAINS(curve, "mean over n = 1 to 3 seeds; thin lines: each seed<");

    // Every row of a table has a cell for each column of its header.
    size_t cells = 0, rows = 0;
    for (const std::string& line : split(markdown, '\n')) {
        if (cells > 0 && !line.empty()) CHECK_EQUAL(count(line, "|"), cells);
        cells = count(line, "|");
        rows += cells > 0;
    }
    // Two lines of a header, then the methods, the runs, the settings that differ, the commands.
    CHECK_EQUAL(rows, size_t{(2 + 3) + (2 + 6) + (2 + 3) + (2 + 6)});
    for (const char* row :
         {"| Settings that differ | DT | ODT | WODTEM (alpha=0.5) |", "| method | dt | odt | wodtem |",
          "| online_steps | 0 | 20000 | 20000 |", "| alpha | 0.75 | 0.75 | 0.5 |"}) {
        CHECK_CONTAINS(markdown, row);
        CHECK_EQUAL(count(narrow(text), row), size_t{0});  // on the pages alone
    }

    std::reverse(folders.begin(), folders.end());  // the order of the arguments does not matter
    report(folders, out);
    CHECK(read_file(out + "/report.html") == page);
}

// The sentence must stand at the end of the text for a terminal, and on both pages above the first section.
void check_verdict(const std::vector<std::string>& folders, const std::string& out, const std::string& verdict) {
    const std::string text = report(folders, out);
    const std::string page = read_file(out + "/report.html"), markdown = read_file(out + "/report.md");
    CHECK_CONTAINS(text, verdict + "\n\n");
    CHECK(text.ends_with(verdict + "\n\n"));
    CHECK_EQUAL(markdown.find("\n\n" + verdict + "\n"), markdown.find('\n'));
    CHECK_EQUAL(page.find("</h1>\n<p>" + svg::escaped(verdict) + "</p>\n<h2>"), page.find("</h1>"));
}

TEST(grid_world_is_compared_with_the_paper_in_one_sentence) {
    const TemporaryFolder temporary;
    const auto run = [&](const char* method, int seed, int length) {
        return write_run(temporary.path, method, seed, {{0, 50}, {900 + seed, length}});
    };
    const std::string out = temporary.path + "/out", start = "gridworld, preset paper, final length: ";
    const std::string odt = run("odt", 0, 100), wodtem = run("wodtem", 0, 5);
    check_verdict({odt, run("dt", 0, 14), wodtem}, out,
                  start +
                      "WODTEM 5.00, paper 5 (sec. V-D), agrees; ODT 100.00, paper about 7 (sec. IV-A), ours is higher; "
                      "DT 14.00, paper no number (fig. 4a); online interactions: up to 900, paper 20,000.");
    // Seeds of 6 and 8 steps: mean 7, deviation sqrt(2). Seeds of 5 and 6 steps are not the paper's 5.
    check_verdict({run("odt", 0, 6), run("odt", 1, 8), wodtem, run("wodtem", 1, 6)}, out,
                  start +
                      "WODTEM 5.50 ± 0.71, paper 5 (sec. V-D), ours is higher; ODT 7.00 ± 1.41, paper about 7 (sec. "
                      "IV-A), agrees; online interactions: up to 901, paper 20,000.");
    // About 7 ends below 8 and above 6.
    for (const int length : {6, 8, 10})
        check_verdict({run("odt", 0, length)}, out,
                      start + "ODT " + std::to_string(length) + ".00, paper about 7 (sec. IV-A), ours is " +
                          (length < 7 ? "lower" : "higher") + "; online interactions: up to 900, paper 20,000.");
    // Unfinished, and without an evaluation.
    std::filesystem::remove(odt + "/finished");
    write(odt, "progress.csv", "interactions,eval_length,eval_return,eval_score\n");
    check_verdict({odt}, out,
                  start +
                      "ODT (unfinished) has no result yet, paper about 7 (sec. IV-A); online interactions: up to "
                      "113, paper 20,000.");
}

TEST(scores_are_compared_with_table_three) {
    // The sums that the paper prints under each group of data sets: DT, ODT, WODTEM.
    const double printed[3][3] = {{499.33, 585.66, 598.10}, {105.80, 136.20, 138.80}, {97.99, 183.96, 255.67}};
    const std::pair<size_t, size_t> groups[] = {{0, 8}, {8, 10}, {10, 13}};
    for (size_t group = 0; group < 3; ++group)
        for (size_t method = 0; method < 3; ++method) {
            double sum = 0;
            for (size_t i = groups[group].first; i < groups[group].second; ++i)
                sum += paper_results[i].by_method[method].mean;
            CHECK_CLOSE(sum, printed[group][method], 1e-9);
        }

    const TemporaryFolder temporary;
    const std::string out = temporary.path + "/out";
    const auto run = [&](const char* task, const char* method, double score, const Origin& origin = {}) {
        return write_mujoco_run(temporary.path, task, method, 0, {{0, 300, 30, 1}, {4000, 300, 60, score}}, origin);
    };
    const std::string task = "maze2d-umaze-v1", start = task + ", preset paper, physics d4rl, final normalised score: ";
    check_verdict(
        {run("maze2d-umaze-v1", "dt", 27.7, {"d4rl", "chosen", "2.2.2", "not known as a published file"}),
         run("maze2d-umaze-v1", "odt", 39.32), run("maze2d-umaze-v1", "wodtem", 64.38)},
        out,
        start +
            "WODTEM 64.38, paper 75.18 ± 10.79, ours is lower; ODT 39.32, paper 31.85 ± 7.46, ours is higher; "
            "DT 27.70, paper 39.95 ± 12.17, ours is lower; online interactions: up to 4,000, paper 200,000; "
            "the data set is not D4RL's file.");
    CHECK_CONTAINS(narrow(read_file(out + "/report.md")), "| WODTEM | 1 | 64.38 ± - | 32.69 ± - | 75.18 ± 10.79 |");
    CHECK_EQUAL(count(read_file(out + "/maze2d-umaze-v1-paper-score.svg"), ">paper: "), size_t{3});
    check_verdict(
        {run("maze2d-umaze-v1", "wodtem", 64.40)}, out,
        start + "WODTEM 64.40, paper 75.18 ± 10.79, agrees; online interactions: up to 4,000, paper 200,000.");
    // A level of the data is part of the name; a task without a level is not in the table.
    const std::string replay = write_mujoco_run(temporary.path, "hopper-medium-replay-v2", "dt", 0, {{0, 9, 9, 62.75}});
    check_verdict(
        {replay}, out,
        "hopper-medium-replay-v2, preset paper, physics d4rl, final normalised score: DT 62.75, paper 62.75 ± "
        "15.05, agrees.");
    const std::string text = narrow(report({run("hopper-v2", "wodtem", 50)}, out));
    CHECK_CONTAINS(text, "WODTEM 50.00; the paper has no result on these data.");
    CHECK_CONTAINS(text, "| WODTEM | 1 | 50.00 ± - | 25.50 ± - | - |");
}

// Two seeds whose last rows are 20, 30 and -- shares; the third run's progress.csv is of an older program.
TEST(the_dose_is_shown_in_thousandths_where_it_was_logged) {
    const TemporaryFolder scratch;
    const auto add_run = [&](int seed, const std::string& dose) {
        const std::string folder = write_run(scratch.path, "wodtem", seed, {{0, 6}});
        write(
            folder, "progress.csv",
            "interactions,eval_length,eval_return,eval_score,advice,advice_distance,advice_shift\n0,6,1,1,nan,nan,nan\n"
            "9,6,1,1," +
                dose + "\n");
        return folder;
    };
    const std::vector<std::string> folders = {add_run(0, "0.02,0.01,0.0005"), add_run(1, "0.03,0.01,0.0015"),
                                              write_run(scratch.path, "wodtem", 2, {{0, 6}, {9, 6}}),
                                              write_run(scratch.path, "odt", 0, {{0, 6}, {9, 6}})};
    report(folders, scratch.path + "/report");
    const std::string page = read_file(scratch.path + "/report/report.md");
    CHECK(narrow(page).find("| WODTEM | 25.00 ± 7.07 | 10.00 ± 0.00 | 1.00 ± 0.71 |") != std::string::npos);
    CHECK(page.find("| ODT | 25") == std::string::npos);
    const std::string header = "interactions,eval_length,eval_return,eval_score,advice,advice_distance,advice_shift\n";
    write(folders[0], "progress.csv", header + "0,6,1,1,0.02,0.01,0.001\n9,6,1,1,0.04,0.01,0.001\n");  // their mean
    CHECK_CONTAINS(narrow(report({folders[0]}, scratch.path + "/report")),
                   "| WODTEM | 30.00 ± - | 10.00 ± - | 1.00 ± - |");
    write(folders[3], "progress.csv",
          header + "0,6,1,1,nan,nan,nan\n9,6,1,1,nan,nan,nan\n");  // of a method without one
    report({folders[3]}, scratch.path + "/report");
    CHECK(read_file(scratch.path + "/report/report.md").find("dose") == std::string::npos);
}

TEST(report_of_a_run_that_has_just_begun_has_dashes) {
    const TemporaryFolder temporary;
    write(temporary.path + "/run", "settings", settings_file("gridworld", "odt", 3, {{"preset", "small"}}));
    report({temporary.path + "/run/"}, temporary.path + "/out");
    const std::string markdown = narrow(read_file(temporary.path + "/out/report.md"));
    CHECK_CONTAINS(markdown, "| ODT | 1 (1 unfinished) | - | - | about 7 (sec. IV-A) | - |");
    CHECK_CONTAINS(markdown, "| ODT seed 3 | unfinished | 0 | - | - | - | - |");
}

TEST(report_of_a_mujoco_task_has_scores_lengths_and_physics) {
    const TemporaryFolder temporary;
    const std::string out = temporary.path + "/out";
    report({write_mujoco_run(temporary.path, "hopper-medium-v2", "odt", 0,
                             {{0, 900, 2000, 61}, {4000, 1000, 3000, 70}, {5000, 1000, 3200, none}}),
            write_mujoco_run(temporary.path, "hopper-medium-v2", "odt", 1, {{0, 800, 1000, 40}, {5100, 700, 0, 50}}),
            write_mujoco_run(temporary.path, "hopper-medium-v2", "dt", 0, {{0, 500, 1500, 47}})},
           out);
    const std::string page = narrow(read_file(out + "/report.md"));
    for (
        const char* part :
        {"hopper-medium-v2, preset paper, physics d4rl\n", "| mujoco=2.2.2 |", "| dataset=a.hdf5 (SHA-256 01234567) |",
         "Physics d4rl: masses and inertias as in MuJoCo up to 2.1.0, which made D4RL's "
         "data. Normalised score, as D4RL defines it: linear in the return, 0 for a random policy (−20.27), 100 for an "
         "expert (3,234.30). An episode ends when the body leaves gym's healthy range, or after 1,000 steps.",
         "| DT | 1 | 47.00 ± - | 47.00 ± - | 61.03 ± 5.11 | 1,500.00 ± - | 500.00 ± - |",
         // scores 70 and 50 (nan is passed over), means (61 + 70) / 2 and (40 + 50) / 2
         "| ODT | 2 | 60.00 ± 14.14 | 55.25 ± 14.50 | 95.56 ± 3.53 | 1,600.00 ± 2,262.74 | 850.00 ± 212.13 |",
         "| ODT seed 1 | finished | 5,100 | 50.00 | 45.00 | ",
         "--method odt --preset paper --seed 1 --dataset a.hdf5 |", "![](hopper-medium-v2-paper-score.svg)"})
        CHECK_CONTAINS(page, part);
    CHECK_CONTAINS(read_file(out + "/hopper-medium-v2-paper-score.svg"), ">normalised score<");
    CHECK_CONTAINS(read_file(out + "/hopper-medium-v2-paper-length.svg"),
                   ">hopper-medium-v2: evaluation length over online interactions<");
    CHECK_CONTAINS(read_file(out + "/hopper-medium-v2-paper-score.svg"),
                   ">preset paper, physics d4rl; mean over n = 1 to 2 seeds; thin lines: each seed<");
}

TEST(a_page_says_how_the_episodes_of_its_task_end) {
    for (const auto& [task, end, has_lengths] :
         {std::tuple("halfcheetah-medium-v2", "Every episode takes 1,000 steps.", false),
          {"antmaze-umaze-v2", "An episode ends at the goal, or after 700 steps.", true}}) {
        const TemporaryFolder temporary;
        const std::string out = temporary.path + "/out/";
        report({write_mujoco_run(temporary.path, task, "odt", 0, {{0, 9, 1, 50}, {900, 9, 1, 50}})}, out);
        CHECK_CONTAINS(read_file(out + "report.md"), end);
        CHECK_EQUAL(std::filesystem::exists(out + task + "-paper-length.svg"), has_lengths);
    }
}

TEST(physics_are_never_mixed) {
    const TemporaryFolder temporary;
    const std::string out = temporary.path + "/out";
    const auto run = [&](int seed, const std::string& physics, const std::string& source, const std::string& version) {
        const std::string parent = temporary.path + "/" + physics + source + version;
        return write_mujoco_run(parent, "walker2d-v2", "odt", seed, {{0, 900, 2000, 10.0 * seed}},
                                {physics, source, version});
    };
    const std::string a = run(1, "d4rl", "chosen", "2.2.2"), b = run(3, "d4rl", "command line", "2.2.2"),
                      c = run(5, "2.2", "command line", "2.2.2");
    report({a, b, c}, out);  // asked for or not, the same physics are the same
    const std::string page = narrow(read_file(out + "/report.md"));
    CHECK_CONTAINS(page, "walker2d-v2, preset paper, physics d4rl\n");
    CHECK_CONTAINS(page, "| ODT | 2 | 20.00 ± 14.14 |");
    CHECK_CONTAINS(page, "walker2d-v2, preset paper, physics 2.2\n");
    CHECK_CONTAINS(page, "| ODT | 1 | 50.00 ± - |");
    CHECK_CONTAINS(page, "Physics 2.2: masses and inertias as MuJoCo 2.2 computes them from the geometry");
    CHECK_CONTAINS(page, "--seed 5 --dataset a.hdf5 --physics 2.2 |");
    CHECK_CONTAINS(page, "![](walker2d-v2-paper-score.svg)");
    CHECK_CONTAINS(page, "![](walker2d-v2-paper-physics-2.2-score.svg)");
    const std::string mixed = narrow(report({a, run(7, "d4rl", "chosen", "2.2.1")}, out));
    CHECK_CONTAINS(mixed, "| ODT (mujoco=2.2.2) | 1 | 10.00 ± - |");
    CHECK_CONTAINS(mixed, "| ODT (mujoco=2.2.1) | 1 | 70.00 ± - |");
    CHECK_FAILS("report.setting", report({run(1, "none", "a", "2.2.2")}, out));
    report({run(1, "d4rl", "a", "<2/2>")}, out);  // any text, since only sentences hold it
    CHECK_CONTAINS(read_file(out + "/report.html"), "<td>mujoco=&lt;2/2&gt;</td>");
}

TEST(only_runs_of_the_same_data_and_first_weights_are_averaged) {
    const TemporaryFolder temporary;
    const std::string out = temporary.path + "/out";
    int folders = 0;
    const auto run = [&](int seed, double score, const char* dataset, const char* sha256, const char* weights) {
        const Origin origin{"d4rl", "chosen", "2.2.2", "not known as a published file", dataset, sha256, weights};
        return write_mujoco_run(temporary.path + "/" + std::to_string(folders++), "hopper-v2", "wodtem", seed,
                                {{0, 9, 9, score}}, origin);
    };
    const std::string a0 = run(0, 1, "a.hdf5", "aaaaaaaaaa", "none"), b1 = run(1, 2, "b.hdf5", "bbbbbbbbbb", "none"),
                      a2 = run(2, 3, "copy.hdf5", "aaaaaaaaaa", "none"),
                      other_a3 = run(3, 4, "a.hdf5", "cccccccccc", "none"),
                      warm0 = run(0, 5, "a.hdf5", "aaaaaaaaaa", "eeeeeeeeee");
    std::string text = narrow(report({a0, b1}, out));
    CHECK_CONTAINS(text, "| WODTEM (dataset=a.hdf5 (SHA-256 aaaaaaaa)) | 1 | 1.00 ± - |");
    CHECK_CONTAINS(text, "| WODTEM (dataset=b.hdf5 (SHA-256 bbbbbbbb)) | 1 | 2.00 ± - |");
    text = narrow(report({a0, other_a3}, out));
    CHECK_CONTAINS(text, "| WODTEM (dataset=a.hdf5 (SHA-256 cccccccc)) | 1 | 4.00 ± - |");
    text = narrow(report({a0, warm0}, out));
    CHECK_CONTAINS(text, "| WODTEM (first_weights=none) | 1 | 1.00 ± - |");
    CHECK_CONTAINS(text, "| WODTEM (first_weights=eeeeeeee) | 1 | 5.00 ± - |");
    text = narrow(report({a0, a2}, out));  // one file under two names
    CHECK_CONTAINS(text, "| WODTEM | 2 | 2.00 ± 1.41 |");
    CHECK_CONTAINS(text, "| dataset=a.hdf5 (SHA-256 aaaaaaaa) |");
    CHECK_FAILS("report.same_seed", report({a0, run(0, 1, "copy.hdf5", "aaaaaaaaaa", "none")}, out));
    // Every setting but the seed sets runs apart, whatever the source says.
    Settings settings = default_settings("hopper-v2", "wodtem", "paper");
    for (const SettingRow& row : setting_rows) {
        Settings changed = settings;
        std::visit(
            [&](auto field) {
                if constexpr (std::is_same_v<decltype(field), std::string Settings::*>)
                    changed.*field += "x";
                else
                    changed.*field = !(changed.*field);
            },
            row.field);
        const std::string name = row.name;
        CHECK_EQUAL(identity_of(changed) == identity_of(settings), name == "seed" || name == "dataset");
    }
}

TEST(an_ablation_has_a_row_and_a_line_for_each_value) {
    const TemporaryFolder temporary;
    const std::string out = temporary.path + "/out";
    std::vector<std::string> folders{write_run(temporary.path, "odt", 0, {{0, 9}, {500, 7}}, {{"width", "64"}})};
    const auto add = [&](const char* alpha, int seed, int length) {
        const Options options = alpha ? Options{{"width", "64"}, {"alpha", alpha}} : Options{{"width", "64"}};
        folders.push_back(write_run(temporary.path + "/" + (alpha ? alpha : "usual"), "wodtem", seed,
                                    {{0, 9}, {500, length}}, options));
    };
    add("0.9", 0, 6);
    add("0.9", 1, 8);
    add("0.5", 0, 5);
    add(nullptr, 0, 10);
    const std::string text = narrow(report(folders, out));
    const char* const rows[] = {"| ODT | 1 | 7.00 ± - |", "| WODTEM (alpha=0.5) | 1 | 5.00 ± - |",
                                "| WODTEM (alpha=0.75) | 1 | 10.00 ± - |", "| WODTEM (alpha=0.9) | 2 | 7.00 ± 1.41 |"};
    size_t last = 0;  // rows in the order of the values
    for (const char* row : rows) {
        CHECK_CONTAINS(text, row);
        CHECK(text.find(row) >= last);
        last = text.find(row);
    }
    CHECK_CONTAINS(text, "| width=64 |");  // which all have, so that no label names it
    CHECK_CONTAINS(text, "WODTEM (alpha=0.9) 7.00 ± 1.41, paper 5 (sec. V-D), ours is higher; WODTEM (alpha=0.75) ");
    const std::string curve = read_file(out + "/gridworld-paper-length.svg");
    for (const char* line : {">ODT<", ">WODTEM (alpha=0.5)<", ">WODTEM (alpha=0.75)<", ">WODTEM (alpha=0.9)<"})
        CHECK_EQUAL(count(curve, line), size_t{1});
    for (const char* colour : {svg::blue, svg::vermillion, svg::purple, "#E69F00"})
        CHECK_EQUAL(count(curve, std::string("stroke=\"") + colour + "\" stroke-width=\"2.5\""),
                    size_t{2});                        // and the legend's
    CHECK_EQUAL(count(curve, ">paper: "), size_t{2});  // one of each method
    for (const char* file : {"wodtem", "wodtem-2", "wodtem-3", "odt"})
        CHECK_CONTAINS(read_file(out + "/report.md"), "(gridworld-paper-grid-" + (file + std::string(".svg)")));
    CHECK_CONTAINS(read_file(out + "/gridworld-paper-grid-wodtem-3.svg"), "WODTEM (alpha=0.9) seed 0<");
}

TEST(curves_join_evaluations_and_show_nothing_that_no_seed_reached) {
    const TemporaryFolder temporary;
    const std::string out = temporary.path + "/out", curve = out + "/gridworld-paper-length.svg";
    const std::string first = write_run(temporary.path, "odt", 0, {{0, 100}, {250, 6}});
    report({first, write_run(temporary.path, "odt", 1, {{0, 20}, {250, 40}})}, out);
    // On an axis of 0 to 100 steps, 3 units each; x = 0 lies at 50 + 39 * 0.61 = 73.79, 250 at 680.
    for (const char* line : {"M 73.79 50 680 332 ", "M 73.79 290 680 230 ", "M 73.79 170 680 281 "})
        CHECK_EQUAL(count(read_file(curve), line), size_t{1});  // the seeds, and their mean: 60 and 23
    CHECK_EQUAL(count(read_file(curve), "fill-opacity"), size_t{0});
    // The mean ends with the seed that is behind: there the other one has come half of the way from 100 to 6.
    const std::string second = write_run(temporary.path, "odt", 1, {{0, 20}, {125, 40}});
    std::filesystem::remove(second + "/finished");
    report({first, second}, out);
    CHECK_EQUAL(count(read_file(curve), "\"M 73.79 170 376.89 210.5 \""), size_t{1});
}

TEST(training_is_drawn_over_updates_and_compared_in_a_sentence) {
    const TemporaryFolder temporary;
    const std::string out = temporary.path + "/out", name = out + "/gridworld-paper-";
    const auto run = [&](const char* method, int seed, const std::string& rows) {
        const std::string folder = write_run(temporary.path, method, seed, {{0, 100}});
        write(folder, "progress.csv",
              "updates,interactions,eval_length,eval_return,eval_score,loss,entropy,lambda,gradient_norm,short,"
              "rollout_return\n" +
                  rows);
        return folder;
    };
    const std::vector<std::string> folders{
        run("dt", 0, "1000,0,9,1,1,5,nan,nan,1,nan,nan\n"),
        run("odt", 0, "1000,0,100,0,0,3,1,0.1,1,nan,nan\n2000,500,7,1,1,2,1,0.1,1,nan,0\n"),
        run("wodtem", 0, "1000,0,100,0,0,3,1,0.1,1,0.9,nan\n7000,500,5,1,1,1,1,0.1,1,0.5,1\n"),
        run("wodtem", 1, "1000,0,100,0,0,3,1,0.1,1,0.9,nan\n9000,500,5,1,1,1,1,0.1,1,0.5,1\n")};
    report({run("wodtem", 2, "1000,0,100,0,0,3,1,0.1,inf,0.9,nan\n7000,500,5,1,1,1,1,0.1,1e200,0.5,1\n")}, out);
    CHECK(!std::filesystem::exists(name + "gradient.svg"));  // nothing that can be drawn
    report(folders, out);
    CHECK_CONTAINS(read_file(out + "/report.md"),
                   "Updates made, mean over seeds: ODT 2,000; WODTEM 8,000, 4.0 times those of ODT. ");
    const auto shown = [&](const char* figure, const char* label) {
        return count(read_file(name + figure + ".svg"), std::string(">") + label + "<");
    };
    for (const char* figure :
         {"length-updates", "loss", "entropy", "lambda", "gradient", "short", "rollouts", "rollouts-updates",
          "loss-interactions", "entropy-interactions", "lambda-interactions", "gradient-interactions"}) {
        CHECK_CONTAINS(read_file(out + "/report.html"), read_file(name + figure + ".svg"));
        CHECK_EQUAL(shown(figure, "WODTEM"), size_t{1});
        CHECK_EQUAL(shown(figure, "ODT"), std::string(figure) == "short" ? size_t{0} : size_t{1});
        CHECK_EQUAL(shown(figure, "DT"), std::string(figure) == "length-updates" ? size_t{1} : size_t{0});
    }
    CHECK_CONTAINS(read_file(name + "loss.svg"), ">preset paper; mean over n = 1 to 2 seeds; thin lines: each seed<");
    // Losses on 0..3, labels of 3 characters: from update 1,000 of 9,000 at 73.79 + 67.36, loss 3, to 9,000, loss 1.
    CHECK_EQUAL(count(read_file(name + "loss.svg"), "M 141.15 50 680 250 "), size_t{1});
    const std::string other = write_run(temporary.path + "/other", "wodtem", 0, {{0, 100}}, {{"alpha", "0.5"}});
    write(other, "progress.csv", "updates,interactions,eval_length,eval_return,eval_score\n4000,0,100,0,0\n");
    report({folders[1], folders[2], folders[3], other}, out);
    CHECK_CONTAINS(read_file(out + "/report.md"),
                   "ODT 2,000; WODTEM (alpha=0.5) 4,000, 2.0 times those of ODT; "
                   "WODTEM (alpha=0.75) 8,000, 4.0 times those of ODT. ");
    write(folders[1], "progress.csv",
          "updates,interactions,eval_length,eval_return,eval_score\n9,0,9,1,1\n8,9,9,1,1\n");
    CHECK_FAILS("csv.order", report({folders[1]}, out));
    const std::string old = write_run(temporary.path, "odt", 5, {{0, 9}, {9, 9}});  // which logged less
    report({old}, temporary.path + "/old");
    CHECK(std::filesystem::exists(temporary.path + "/old/gridworld-paper-length.svg"));
    for (const char* figure : {"length-updates", "loss", "rollouts"})
        CHECK(!std::filesystem::exists(temporary.path + "/old/gridworld-paper-" + figure + ".svg"));
    CHECK_EQUAL(count(read_file(temporary.path + "/old/report.md"), "Updates made"), size_t{0});
}

TEST(bars_stand_on_one_scale_and_only_where_there_are_runs) {
    const TemporaryFolder temporary;
    const std::string out = temporary.path + "/out";
    const std::string odt = write_run(temporary.path, "odt", 0, {{0, 9}, {90, 5}});
    const std::string wodtem = write_run(temporary.path, "wodtem", 0, {{0, 9}, {90, 5}});
    std::string start = "move,learned,offline,online\n";
    for (const GridMove& m : grid_move_table)
        start += m.name + std::string(m.name[0] == 'U' ? ",0.9" : ",0") + ",0,nan\n";
    write(wodtem, "start_actions.csv", start);
    write(wodtem, "episodes.csv", "episode,interactions,length,return\n");
    report({odt, wodtem}, out);
    const std::string a = read_file(out + "/gridworld-paper-start-odt.svg"),
                      b = read_file(out + "/gridworld-paper-start-wodtem.svg"),
                      episodes = read_file(out + "/gridworld-paper-episodes.svg");
    CHECK_EQUAL(count(a, ">1.0<") + count(b, ">1.0<"), size_t{2});  // the top of both axes
    CHECK_EQUAL(count(a, "height=\"37.5\""), size_t{3 * 8});        // 0.125 of 300
    CHECK_EQUAL(count(b, "height=\"270\""), size_t{1});
    CHECK_EQUAL(count(a, ">D_online<"), size_t{1});
    CHECK_EQUAL(count(b, ">D_online<"), size_t{0});
    CHECK_EQUAL(count(episodes, ">ODT<"), size_t{1});
    CHECK_EQUAL(count(episodes, ">WODTEM<"), size_t{0});
}

TEST(a_folder_of_runs_stands_for_the_runs_up_to_three_levels_below_it) {
    const TemporaryFolder temporary;
    const std::string runs = temporary.path + "/runs", out = runs + "/report";
    const std::string a = write_run(runs, "odt", 0, {{0, 9}, {90, 5}}), b = write_run(runs, "dt", 0, {{0, 9}});
    const std::string c = write_run(runs + "/deeper", "odt", 1, {{0, 9}, {90, 5}});
    write_run(runs + "/deeper/still/more", "odt", 2, {{0, 9}, {90, 5}});  // too deep
    write(runs, "notes", "no folder");
    for (const auto& [to, link] : {std::pair("circle", "/circle"), {".", "/here"}, {"..", "/deeper/up"}})
        std::filesystem::create_symlink(to, runs + link);
    const std::string text = report({a, b, c}, out);
    const std::string page = read_file(out + "/report.html");
    CHECK_EQUAL(report({runs}, out), text);
    CHECK(read_file(out + "/report.html") == page);
    CHECK(report({temporary.path}, out).find("ODT seed 1") != std::string::npos);  // three levels below
    std::filesystem::create_directories(temporary.path + "/empty/a/b");
    for (const std::string& none_there : {temporary.path + "/empty", runs + "/notes", runs + "/missing"})
        CHECK_FAILS("report.folder", report({none_there}, out));
    CHECK_FAILS("report.same_seed", report({runs, a}, out));
    write(c, "progress.csv", "no columns\n");  // below a folder it is left out with a sentence, by name an error
    CHECK_EQUAL(report({temporary.path}, out).find("ODT seed 1"), std::string::npos);
    CHECK_FAILS("csv.column", report({c}, out));
    write(write_run(temporary.path + "/empty", "odt", 3, {{0, 9}}), "progress.csv", "no columns\n");
    CHECK_FAILS("report.nothing", report({temporary.path + "/empty"}, out));
}

TEST(pages_link_the_files_of_a_run_and_say_when_and_where_it_was_made) {
    const TemporaryFolder temporary;
    const std::string out = temporary.path + "/out", header = "updates,interactions,seconds,date,machine,program\n";
    const std::string run = write_run(temporary.path, "odt", 0, {{0, 9}, {90, 5}});
    // 1,000 updates in 20 s; killed, continued at update 900: 4,100 updates in 55 s.
    write(run, "seconds.csv",
          header + "0,0,0.000,a,m,p\n1000,50,20.000,b,m,p\n900,40,20.000,c,m,p\n5000,90,75.000,d,<m>,q\n");
    const std::string text = report({run}, out), page = read_file(out + "/report.html");
    CHECK_CONTAINS(narrow(read_file(out + "/report.md")), "| ODT seed 0 | d | 1:15 | 68 | <m> | q |");
    CHECK_CONTAINS(page, "<td>&lt;m&gt;</td>");
    CHECK_EQUAL(count(text, "Updates a second") + count(text, "seconds.csv"), size_t{0});
    CHECK_CONTAINS(page, "ODT seed 0: <a href=\"../odt-0/settings\">settings</a> <a href=\"../odt-0/progress.csv\">");
    CHECK_CONTAINS(read_file(out + "/report.md"), " [seconds.csv](../odt-0/seconds.csv)\n");
    CHECK_EQUAL(count(page, "/command\""), size_t{0});  // this folder has none
    write(run, "seconds.csv", header + "0,0,0.000,a,m,p\n");
    report({run}, out);
    CHECK_CONTAINS(narrow(read_file(out + "/report.md")), "| ODT seed 0 | a | 0:00 | - | m | p |");
    write(run, "seconds.csv", header);
    report({run}, out);
    CHECK_EQUAL(count(read_file(out + "/report.md"), "Updates a second"), size_t{0});
    // No result depends on the file: one that cannot be read leaves dashes and a sentence.
    for (const auto& [rows, what] : {std::pair("0,0,5,a,m,p\n9,0,4,a,m,p\n", "line 3: column \"seconds\" falls to 4"),
                                     {"0,0,x\xff,a,m,p\n", "line 2: column \"seconds\" holds \"x\\xff\""},
                                     {"0,0,1", "line 2 does not end"}}) {
        write(run, "seconds.csv", header + rows);
        report({run}, out);
        const std::string damaged = narrow(read_file(out + "/report.md"));
        CHECK_CONTAINS(damaged, "| ODT seed 0 | - | - | - | - | - |");
        CHECK_CONTAINS(damaged, "A run has no times: " + run + "/seconds.csv: " + what);
        CHECK_CONTAINS(damaged, "| ODT | 1 | 5.00 ± - |");
    }
    // Links count from a folder of pages that is not there yet, too.
    const std::filesystem::path here = std::filesystem::current_path();
    std::filesystem::current_path(temporary.path);
    report({"odt-0"}, "fresh/pages");
    std::filesystem::current_path(here);
    CHECK_CONTAINS(read_file(temporary.path + "/fresh/pages/report.html"), "<a href=\"../../odt-0/settings\">");
}

// A finished run on own data: two evaluations, at updates 0 and 60; the numbers are those of the latter.
std::string write_own_run(const std::string& parent, const std::string& method, const std::string& dataset,
                          const std::string& sha256, int moves, const std::string& loss, const std::string& log_prob,
                          const std::string& error) {
    const std::string folder = parent + "/" + method + "-" + sha256 + "-" + std::to_string(moves);
    Settings settings = default_settings(own_data, method, "small");
    set_from(settings, "dataset", dataset, "own data");
    set_from(settings, "dataset_sha256", sha256, "of the file");
    for (const auto& [name, value] : {std::pair("state_dim", 2), {"action_dim", 1}, {"moves", moves}})
        set_from(settings, name, std::to_string(value), "the data set");
    write(folder, "settings", settings_text(settings));
    write(folder, "command", train_command(settings) + "\n");
    write(folder, "progress.csv",
          "updates,interactions,eval_length,eval_return,eval_score,loss,held_out_log_prob,held_out_error\n"
          "0,0,nan,nan,nan,nan,-9,0.9\n60,0,nan,nan,nan," +
              loss + "," + log_prob + "," + error + "\n");
    write(folder, "episodes.csv", "interactions,length,return\n");
    write(folder, "finished", "");
    return folder;
}

TEST(own_data_are_compared_by_their_action_error_and_named_where_they_differ) {
    const TemporaryFolder temporary;
    const std::string out = temporary.path + "/out", figures = out + "/data-own-small-";
    const auto run = [&](const char* method, const char* sha256, int moves, const char* log_prob, const char* error) {
        return write_own_run(temporary.path, method, "own.hdf5", sha256, moves, "0.5", log_prob, error);
    };
    const std::string dt = run("dt", "aaaaaaaaaa", 0, "-0.25", "0.25");
    const std::string odt = run("odt", "aaaaaaaaaa", 0, "-7", "0.125");
    std::string text = narrow(report({dt, odt}, out));
    for (const char* row :
         {"| Method | Seeds | Final action error, held out | Mean of last 10 | Final log-probability, held out |",
          "| DT | 1 | 0.2500 ± - | 0.5750 ± - | - |", "| ODT | 1 | 0.1250 ± - | 0.5125 ± - | −7.00 ± - |",
          "| Run | State | Updates | Final action error, held out | Last 10 | Folder |",
          "| ODT seed 0 | finished | 60 | 0.1250 | 0.5125 |", "| dataset=own.hdf5 (SHA-256 aaaaaaaa) |"})
        CHECK_CONTAINS(text, row);
    // A squared error stands in no picture of likelihoods.
    for (const auto& [figure, dts, odts] :
         {std::tuple("held-out-error", 1, 1), {"held-out", 0, 1}, {"loss", 0, 1}, {"dt-loss", 1, 0}}) {
        const std::string svg_text = read_file(figures + (figure + std::string(".svg")));
        CHECK_EQUAL(count(svg_text, ">DT<"), static_cast<size_t>(dts));
        CHECK_EQUAL(count(svg_text, ">ODT<"), static_cast<size_t>(odts));
    }
    // DT of moves is trained by their likelihood.
    text = narrow(report({run("dt", "aaaaaaaaaa", 4, "-0.5", "0.25")}, out));
    CHECK_CONTAINS(text, "| DT | 1 | 0.2500 ± - | 0.5750 ± - | −0.50 ± - |");
    text = report({odt, run("dt", "cccccccccc", 4, "-0.5", "0.25")}, out);  // another measure: a section of its own
    CHECK(text.find("data-own, preset small") < text.find("data-own-moves, preset small"));
    CHECK(text.find("data-own-moves, preset small") != std::string::npos);
    text = narrow(report({odt, run("odt", "bbbbbbbbbb", 0, "-7", "0.5")}, out));
    CHECK_CONTAINS(text, "| ODT (dataset=own.hdf5 (SHA-256 aaaaaaaa)) | 1 | 0.1250 ± - |");
    CHECK_CONTAINS(text, "| ODT (dataset=own.hdf5 (SHA-256 bbbbbbbb)) | 1 | 0.5000 ± - |");
    // The same data under another name stand in the same section; the sentence claims nothing about the paper.
    text =
        narrow(report({odt, write_own_run(temporary.path, "dt", "copy.hdf5", "aaaaaaaaaa", 0, "1", "-1", "1")}, out));
    CHECK_EQUAL(count(text, "preset small, final action error, held out: "), size_t{1});
    CHECK_CONTAINS(text, ": ODT 0.1250; DT 1.0000; the paper has no result on these data.");
}

TEST(a_data_set_may_have_any_name) {
    const TemporaryFolder temporary;
    const std::string out = temporary.path + "/out";
    const std::string line = write_own_run(temporary.path, "dt", "a\nb|.hdf5", "a", 0, "1", "-1", "1");
    const std::string byte = write_own_run(temporary.path, "odt", "a\xff.hdf5", "b", 0, "1", "-1", "1");
    report({line, byte}, out);
    const std::string markdown = narrow(read_file(out + "/report.md")), page = read_file(out + "/report.html");
    CHECK(is_utf8(markdown) && is_utf8(page));
    CHECK_CONTAINS(markdown, "\n## data-a\\x0ab|, preset small\n");
    CHECK_CONTAINS(markdown, "| dataset=a\\x0ab\\|.hdf5 (SHA-256 a) |");
    CHECK_CONTAINS(markdown, "![](data-a%0Ab|-small-held-out-error.svg)");
    CHECK(std::filesystem::exists(out + "/data-a\nb|-small-held-out-error.svg"));
    CHECK_CONTAINS(page, ">data-a\\xff: action error, held out over updates<");
    // The shell reads the printed name as it is.
    const size_t at = page.find("./wodtem train ") + 15;
    const std::string word = page.substr(at, page.find(" --method", at) - at), copy = temporary.path + "/word";
    CHECK_EQUAL(std::system(("bash -c " + shell_word("printf %s " + word + " > " + copy)).c_str()), 0);
    CHECK_EQUAL(std::filesystem::path(read_file(copy)).filename().string(), "a\nb|.hdf5");
}

// The command in a report's only table of commands with one run.
std::string printed_command(const std::string& text) {
    const size_t begin = text.rfind("| ./wodtem train ") + 2;
    return trimmed(text.substr(begin, text.find(" | ", begin) - begin));
}

TEST(the_command_names_whatever_decides_a_run) {
    Settings settings = default_settings("hopper-v2", "wodtem", "small");
    CHECK_EQUAL(train_command(settings),
                "./wodtem train hopper-v2 --method wodtem --preset small --seed 0 --dataset random");
    settings.seed = 7;
    set_from(settings, "physics", "2.2", "command line");
    settings.arithmetic = "bf16";
    settings.dataset = "it's.hdf5";
    settings.first_weights = "0123abcd";
    set_from(settings, "gamma", "0.5", "command line");
    const std::string start = "./wodtem train hopper-v2 --method wodtem --preset small --seed 7 --dataset ";
    CHECK_EQUAL(train_command(settings), start +
                                             "'it'\\''s.hdf5' --physics 2.2 --weights model-of-sha256-0123abcd "
                                             "--precision bf16 --set gamma=0.5");
    settings.dataset_path = "/a b/it's.hdf5";
    settings.weights_path = "m.safetensors";
    settings.arithmetic = "plain";
    const std::string weights = shell_word(std::filesystem::current_path() / "m.safetensors");
    CHECK_EQUAL(train_command(settings), start + "'/a b/it'\\''s.hdf5' --physics 2.2 --weights " + weights +
                                             " --kernel portable --set gamma=0.5");
    // A folder's own command is printed; one that was written before there were any has what its settings know.
    const TemporaryFolder temporary;
    const std::string folder = write_mujoco_run(temporary.path, "hopper-v2", "odt", 0, {{0, 9, 9, 1}});
    const std::string old = "./wodtem train hopper-v2 --method odt --preset paper --seed 0 --dataset a.hdf5";
    CHECK_EQUAL(printed_command(report({folder}, temporary.path + "/out")), old);
    write(folder, "command", "./wodtem train hopper-v2 --dataset /b/a.hdf5\n");
    CHECK_EQUAL(printed_command(report({folder}, temporary.path + "/out")),
                "./wodtem train hopper-v2 --dataset /b/a.hdf5");
}

TEST(the_printed_command_repeats_the_run) {
    const TemporaryFolder temporary;
    const std::string first = temporary.path + "/it's a run", warm = temporary.path + "/warm";
    const auto succeeds = [](const std::string& command) {
        CHECK_EQUAL(std::system(("(" + command + ") > /dev/null 2>&1").c_str()), 0);
    };
    const auto repeat = [&](const std::string& folder, const std::string& copy) {
        const std::string command = printed_command(report({folder}, temporary.path + "/out"));
        succeeds(command + " --out " + shell_word(copy));
        size_t files = 0;
        for (const auto& entry : std::filesystem::directory_iterator(folder)) {
            const std::string name = entry.path().filename();
            if (name == "seconds.csv") continue;
            ++files;
            CHECK(read_file(folder + "/" + name) == read_file(copy + "/" + name));
        }
        CHECK(files >= 6);
    };
    const std::string small = " --set offline_updates=20 --set online_steps=200 --set updates_per_iteration=2";
    succeeds("./wodtem train gridworld --seed 3 --kernel portable --set alpha=0.5 --set edge=stays" + small +
             " --out " + shell_word(first));
    repeat(first, temporary.path + "/second");
    succeeds("cd " + shell_word(first) + " && " + shell_word(std::filesystem::current_path() / "wodtem") +
             " train gridworld --method odt --weights model.safetensors --set edge=stays" + small + " --out " + warm);
    repeat(warm, temporary.path + "/warm again");
#ifdef WODTEM_MUJOCO
    for (const char* physics : {"", " --physics d4rl"}) {  // what was asked for has another source
        const std::string maze = temporary.path + "/maze" + physics;
        succeeds("./wodtem train maze2d-umaze-v1 --preset small --dataset random --set width=8" + std::string(physics) +
                 " --set offline_updates=2 --set online_steps=1 --set updates_per_iteration=1"
                 " --set eval_episodes=1 --out " +
                 shell_word(maze));
        repeat(maze, maze + " again");
    }
#endif
}

TEST(report_draws_the_paths_through_a_maze) {
    const TemporaryFolder temporary;
    const std::string out = temporary.path + "/out", header = "episode,step,goal_x,goal_y,x,y\n";
    const auto ball = [&](const char* method, int seed) {
        return write_mujoco_run(temporary.path, "maze2d-umaze-v1", method, seed,
                                {{0, 300, 30, 4.5}, {20050, 300, 60, 26.2}});
    };
    const std::string first = ball("odt", 0), second = ball("odt", 1), dt = ball("dt", 0);
    report({first, second, dt}, out);  // no paths.csv anywhere
    CHECK(read_file(out + "/report.md").find("paths") == std::string::npos);

    // Observed (2, 0.8) lies at row 2.2, column 1 of the map, cells of 96, the first at (48, 76).
    write(second, "paths.csv",
          header + "0,0,1,1,2,0.8\n0,1,1,1,1.5,0.8\n1,0,1,1,2.8,2.8\n1,1,1,1,2.8,1.8\n2,0,1,1,1.4,0.7\n2,1,1,1,3,1\n");
    write(first, "paths.csv", header);
    std::filesystem::remove(second + "/finished");
    report({dt, second, first}, out);
    const std::string maze = read_file(out + "/maze2d-umaze-v1-paper-paths-odt.svg");
    const std::string page = read_file(out + "/report.md");
    CHECK_CONTAINS(maze, "maze2d-umaze-v1: paths of ODT seed 1");
    CHECK_CONTAINS(maze, "d=\"M 192 335.2 192 287.2 \"");
    CHECK_CONTAINS(maze, "<circle cx=\"211.2\" cy=\"239.2\" r=\"48\"");  // observed (1, 1) is (1.2, 1.2)
    CHECK_CONTAINS(maze, "goal (radius 0.5 m)");
    CHECK_EQUAL(count(maze, "#C8C8C8"), size_t{18});  // 25 cells, 7 free
    CHECK_EQUAL(count(maze, "r=\"48\""), size_t{1});  // one goal for all episodes
    CHECK_CONTAINS(page, "![](maze2d-umaze-v1-paper-paths-odt.svg)");
    CHECK_CONTAINS(
        page,
        "The latest evaluation of ODT seed 1, unfinished: 1 of 3 episodes came within 0.5 m of the goal at some time. "
        "None ends there: the score counts the steps within that distance.");
    CHECK(page.find("paths-dt") == std::string::npos);
    CHECK(page.find("-length.svg") == std::string::npos);  // every episode takes 300 steps
    CHECK_CONTAINS(page, "Every episode takes 300 steps.");

    // Observed (8, 1) of an ant lies at row 1.25, column 3. Twelve episodes: ten are drawn.
    const std::string ant =
        write_mujoco_run(temporary.path, "antmaze-umaze-v2", "wodtem", 0, {{0, 700, 0.5, 50}, {900, 700, 0.5, 50}});
    std::string paths = header;
    for (int i = 0; i < 12; ++i)
        for (const char* step : {",0,", ",1,"})
            paths += std::to_string(i) + step + "0.8,8." + std::to_string(i) + (step[1] == '0' ? ",8,1\n" : ",1,8.4\n");
    write(ant, "paths.csv", paths);  // the tenth ends 0.54 m from its goal
    report({ant}, out);
    const std::string ant_maze = read_file(out + "/antmaze-umaze-v2-paper-paths-wodtem.svg");
    CHECK_EQUAL(count(ant_maze, "d=\"M 384 244 216 421.6 \""), size_t{10});
    CHECK_CONTAINS(ant_maze, ">preset paper, physics d4rl; one run, of n = 1 seed<");
    CHECK_CONTAINS(read_file(out + "/antmaze-umaze-v2-paper-score.svg"), ">preset paper, physics d4rl; n = 1 seed<");
    CHECK_CONTAINS(ant_maze, "<circle cx=\"211.2\" cy=\"421.6\" r=\"12\"");  // (0.8, 8.4): row 3.1, column 1.2
    CHECK_EQUAL(count(ant_maze, "r=\"12\""), size_t{10});
    CHECK_CONTAINS(
        read_file(out + "/report.md"),
        "11 of 12 episodes came within 0.5 m of the goal, which ended them; each has a goal of its own, circled "
        "in its colour. The first 10 are drawn.");
}

TEST(paths_that_cannot_be_are_refused_with_their_line) {
    const TemporaryFolder temporary;
    const std::string run = write_mujoco_run(temporary.path, "maze2d-large-v1", "odt", 0, {{0, 800, 30, 4.5}});
    const std::string head = "episode,step,goal_x,goal_y,x,y\n0,0,7,9,1,1\n0,1,7,9,1,1\n", file = run + "/paths.csv";
    const auto fails = [&](const char* id, const std::string& text, const std::string& place) {
        write(run, "paths.csv", text);
        try {
            report({run}, temporary.path + "/out");
            CHECK_EQUAL(text, "was not refused");
        } catch (const Error& error) {
            CHECK_EQUAL(error.id, id);
            CHECK_CONTAINS(std::string(error.what()), file + ": " + place);
        }
    };
    fails("csv.unfinished", "", "line 1 ");
    fails("csv.unfinished", head + "0,2,7,9,1", "line 4 ");
    fails("csv.column", "episode,step,goal_x,goal_y,x\n", "line 1 ");
    fails("csv.fields", head + "0,2,7,9,1\n", "line 4 ");
    for (const char* row : {"0,2,7,9,1,y", "0,2,7,9,1,", "0,2,7,9,1,1\r", "0,2,7,9,1,\"1\"", "nan,2,7,9,1,1",
                            "-1,0,7,9,1,1", "0,nan,7,9,1,1", "0,801,7,9,1,1", "0,2,7,9,nan,1", "0,2,7,9,1,inf",
                            "0,2,7,9,-1001,1", "0,2,7,nan,1,1", "0,2,1e300,9,1,1"})
        fails("csv.number", head + row + "\n", "line 4: column ");
    for (const char* row :
         {"0,3,7,9,1,1", "0,1,7,9,1,1", "1,2,7,9,1,1", "0,0,7,9,1,1", "2,0,7,9,1,1", "0,1.5,7,9,1,1", "0,2,7,9.5,1,1"})
        fails("csv.order", head + row + "\n", "line 4: ");
    fails("csv.order", "episode,step,goal_x,goal_y,x,y\n0,1,7,9,1,1\n", "line 2: ");
    write(run, "paths.csv", head + "0,2,7,9,-900,900\n");  // a simulation may throw the body out of the maze
    report({run}, temporary.path + "/out");
    const std::string svg = read_file(temporary.path + "/out/maze2d-large-v1-paper-paths-odt.svg");
    CHECK_CONTAINS(svg, " 648 76 \"");  // the map's upper right corner

    const std::string hopper = write_mujoco_run(temporary.path, "hopper-v2", "odt", 0, {{0, 800, 30, 4.5}});
    write(hopper, "paths.csv", "not of a maze");  // and so not looked at
    report({hopper}, temporary.path + "/out");
}

TEST(report_names_each_way_a_folder_can_be_wrong) {
    const TemporaryFolder temporary;
    const std::string out = temporary.path + "/out", good = write_run(temporary.path, "odt", 0, {{0, 9}, {90, 5}});
    CHECK_FAILS("report.nothing", report({}, out));
    CHECK_FAILS("report.folder", report({temporary.path + "/odt-0/settings"}, out));
    CHECK_FAILS("report.same_seed", report({good, good + "/"}, out));
    CHECK_FAILS("report.write", report({good}, good + "/settings/out"));

    // One file is replaced at a time; every other one is good.
    const auto fails = [&](const char* id, const std::string& name, const std::string& text) {
        const std::string kept = read_file(good + "/" + name);
        write(good, name, text);
        CHECK_FAILS(id, report({good}, out));
        write(good, name, kept);
    };
    const std::string settings = read_file(good + "/settings"), policy = policy_csv("R"), start = start_csv();
    fails("settings.line", "settings", settings + "x\n");
    fails("settings.missing", "settings", settings.substr(settings.find('\n') + 1));  // no task
    const auto spoilt = [&](const char* name, const char* value) {
        const size_t at = settings.find(" = ", settings.find(std::string(name) + " = ")) + 3;
        return std::string(settings).replace(at, settings.find(' ', at) - at, value);
    };
    fails("settings.value", "settings", spoilt("task", "../x"));
    fails("settings.value", "settings", spoilt("method", "sac"));
    fails("settings.value", "settings", spoilt("seed", "1x"));
    fails("settings.value", "settings", spoilt("edge", "round"));
    fails("csv.unfinished", "progress.csv", "interactions,eval_length,eval_return,eval_score\n0,9,1,1");
    fails("csv.fields", "progress.csv", "interactions,eval_length,eval_return,eval_score\n0,9,1\n");
    fails("csv.number", "progress.csv", "interactions,eval_length,eval_return,eval_score\n0,9,1,x\n");
    fails("csv.column", "progress.csv", "interactions,eval_length,eval_return\n0,9,1\n");
    fails("csv.order", "progress.csv", "interactions,eval_length,eval_return,eval_score\n9,9,1,1\n8,9,1,1\n");
    fails("csv.number", "progress.csv", "interactions,eval_length,eval_return,eval_score\nnan,9,1,1\n");
    fails("csv.number", "episodes.csv", "interactions,length,return\n101,101,0\n");
    fails("csv.number", "episodes.csv", "interactions,length,return\n1,0,0\n");
    fails("csv.number", "policy.csv", std::string(policy).replace(policy.find("0.65"), 4, "1.65"));
    fails("csv.rows", "policy.csv", policy + "6,0,1,0,0,0,0,0,0,0\n");
    fails("csv.rows", "policy.csv", policy.substr(0, policy.rfind("\n5,5") + 1));
    fails("csv.rows", "start_actions.csv", std::string(start).replace(start.find("\nD,"), 3, "\nX,"));
    std::filesystem::remove(good + "/policy.csv");  // finished, so it must be there
    CHECK_FAILS("file.open", report({good}, out));
}

TEST(cells_out_of_place_are_named_with_their_line) {
    const Log log("policy.csv", "row\n0\n1\n3\n");
    try {
        log.check_column("row", 3, [](int i) { return std::to_string(i); });
        CHECK(!"in place");
    } catch (const Error& error) {
        CHECK_CONTAINS(std::string(error.what()), "policy.csv: line 4: column \"row\" does not name the 3 cells");
    }
}

TEST(durations_are_hours_minutes_and_seconds) {
    for (const auto& [seconds, text] :
         {std::pair(75.9, "1:15"), {3599.0, "59:59"}, {3675.0, "1:01:15"}, {-1.0, "0:00"}})
        CHECK_EQUAL(clock_text(seconds), text);
}

TEST(csv_errors_name_the_line) {
    const TemporaryFolder temporary;
    const std::string path = temporary.path + "/progress.csv";
    write_file_atomic(path, "step,loss\n0,nan\n1000,-1.5e-3\n");
    const Log log(path);
    CHECK_EQUAL(log.table.rows.size(), size_t{2});
    CHECK(equal(log.numbers("loss", -1, 0, true), {none, -0.0015}));
    CHECK_FAILS("csv.number", log.numbers("loss", -1, 0));
    CHECK_FAILS("csv.number", log.numbers("step", 0, 999));
    CHECK_FAILS("csv.column", log.numbers("los", 0, 1));
    CHECK_FAILS("csv.unfinished", Log("f", ""));
    CHECK_FAILS("csv.unfinished", Log("f", "a,b\n1,2"));
    CHECK_FAILS("csv.fields", Log("f", "a,b\n1\n"));
    CHECK_FAILS("csv.fields", Log("f", "a,b\n\n"));
    try {
        Log("progress.csv", "a,b\n1,2\n1,2,3\n");
    } catch (const Error& error) {
        CHECK_EQUAL(std::string(error.what()), "progress.csv: line 3 has 3 fields, the header has 2");
    }
    try {
        log.numbers("step", 0, 999);
    } catch (const Error& error) {
        CHECK_EQUAL(std::string(error.what()),
                    path + ": line 3: column \"step\" holds \"1000\", expected a number from 0 to 999");
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// The runs of data/RESULTS.md that are stored in data/results.

namespace {
// The row of a table of a page that begins with these cells.
std::string row_of(const std::string& page, const std::string& first_cells) {
    const size_t at = page.find("\n| " + first_cells + " |");
    return at == std::string::npos ? "" : page.substr(at + 1, page.find('\n', at + 1) - at - 1);
}

}  // namespace

// Each archive holds run folders; the figures that the page shows of them, and its numbers, are those of the program.
TEST(stored_runs_redraw_the_figures_and_give_the_numbers_of_the_results_page) {
    const std::string page = read_file("data/RESULTS.md");
    size_t figures = 0;
    for (const auto& archive : std::filesystem::directory_iterator("data/results")) {
        // Its figures have the names of those at width 8, which are shown.
        if (archive.path().filename() == "gridworld-width-64.tar.gz") continue;
        const TemporaryFolder folder;
        const std::string unpack = "tar -xzf " + archive.path().string() + " -C " + folder.path;
        CHECK_EQUAL(std::system(unpack.c_str()), 0);
        const std::string out = folder.path + "/report";
        report({folder.path}, out);
        for (const auto& drawn : std::filesystem::directory_iterator(out)) {
            // Umaze's other figure of this name is of runs whose data were cut elsewhere.
            const std::string prefix = archive.path().filename() == "maze2d-umaze-flags.tar.gz" ? "flags-" : "";
            const std::string shown = "data/figures/" + prefix + drawn.path().filename().string();
            if (!std::filesystem::exists(shown)) continue;
            ++figures;
            if (read_file(drawn.path()) != read_file(shown)) report_failure(__FILE__, __LINE__, shown + " is another");
        }
    }
    CHECK_EQUAL(figures, size_t{14});
    for (const auto& [archive, runs_of, maze, count] : {std::tuple("maze2d-reduced", "large", "large", 19),
                                                        {"maze2d-umaze-flags", "umazeflags", "umaze, flags", 15}}) {
        const TemporaryFolder folder;
        const std::string file = "data/results/" + std::string(archive) + ".tar.gz";
        CHECK_EQUAL(std::system(("tar -xzf " + file + " -C " + folder.path).c_str()), 0);
        for (const auto& [method, label] : {std::pair("odt", "ODT"), {"wodtem", "WODTEM"}}) {
            std::vector<Run> runs;
            for (int seed = 0; seed < count; ++seed)
                runs.push_back(read_run(text_of(folder.path, "/", runs_of, "-", method, "-", seed)));
            Runs pointers;
            for (const Run& run : runs) pointers.push_back(&run);
            const std::string row = row_of(page, text_of(maze, " | ", label, " | 0 to ", count - 1));
            for (const Summary summary : {last_ten, final_value}) {
                const std::string number = plus_minus(over_seeds(pointers, summary, "eval_score"), 1);
                if (row.find("| " + number + " |") == std::string::npos)
                    report_failure(__FILE__, __LINE__, number + " is not in: " + row);
            }
        }
    }
}
