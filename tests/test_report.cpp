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

// A finished grid-world run; each evaluation is {interactions, length}.
std::string write_run(const std::string& parent, const std::string& method, int seed,
                      const std::vector<std::pair<int, int>>& evaluations, const std::string& more_settings = "") {
    const std::string folder = parent + "/" + method + "-" + std::to_string(seed);
    write(folder, "settings",
          "task = gridworld    # command line\nmethod = " + method +
              "  # command line\npreset = paper # command line\n" + "seed = " + std::to_string(seed) +
              "   # command line\narithmetic = plain # the kernel\n" + more_settings);
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

Run run_with(const std::vector<double>& interactions, const std::vector<double>& length, bool finished) {
    Run run;
    run.interactions = interactions, run.length = length, run.finished = finished;
    run.so_far = interactions.back();
    return run;
}

bool equal(const std::vector<double>& got, const std::vector<double>& expected) {
    bool same = got.size() == expected.size();
    for (size_t i = 0; same && i < got.size(); ++i)
        same = got[i] == expected[i] || (std::isnan(got[i]) && std::isnan(expected[i]));
    return same;
}

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
    const Spread got = spread_of({2, none, 4, 4, 4, 5, 5, 7, 9});  // mean 5, squares 9 1 1 1 0 0 4 16: 32 / 7
    CHECK_EQUAL(got.count, size_t{8});
    CHECK_CLOSE(got.mean, 5, 0);
    CHECK_CLOSE(got.deviation, 2.138089935299395, 1e-15);
    CHECK_EQUAL(plus_minus(spread_of({5, 5})), "5.00 ± 0.00");
    CHECK_EQUAL(plus_minus(spread_of({5})), "5.00 ± -");
    CHECK_EQUAL(plus_minus(spread_of({none})), "-");
}

TEST(resampling_takes_the_last_evaluation_at_or_before_each_point) {
    const Run run = run_with({0, 240, 250, 600, 760, 1010}, {50, 40, 30, 20, none, 10}, true);
    CHECK(equal(curve_points({&run}), {0, 250, 500, 750, 1000}));
    // 760 has no value; 1010 is the final one and shows at the last point
    CHECK(equal(resampled(run, &Run::length, {0, 249, 250, 500, 750, 900, 1000}), {50, 40, 30, 30, 20, 20, 10}));
}

TEST(unfinished_run_ends_where_it_stands_and_finished_one_keeps_its_last_value) {
    const Run open = run_with({0, 260}, {9, 8}, false), done = run_with({0, 260}, {9, 8}, true);
    CHECK(equal(resampled(open, &Run::length, {0, 250, 260, 500}), {9, 9, 8, none}));
    CHECK(equal(resampled(done, &Run::length, {0, 250, 260, 500}), {9, 9, 8, 8}));
    std::vector<double> mean, deviation;
    fill_spread(mean, deviation, std::vector<std::vector<double>>{{4, 6}, {8, none}});
    CHECK(equal(mean, {6, 6}) && equal(deviation, {std::sqrt(8.0), none}));
}

TEST(length_five_counts_from_the_evaluation_after_which_it_never_left) {
    CHECK_CLOSE(kept_from(run_with({0, 100, 200, 300, 400}, {9, 5, 6, 5, 5}, true), 5), 300, 0);
    CHECK_CLOSE(kept_from(run_with({0, 100}, {5, 5}, true), 5), 0, 0);
    CHECK(std::isnan(kept_from(run_with({0, 100, 200}, {5, 5, 6}, true), 5)));
    CHECK(std::isnan(kept_from(run_with({0, 100}, {5, none}, true), 5)));
}

TEST(each_length_falls_into_the_bar_whose_label_says_so) {
    std::vector<double> counts(bin_ends.size(), 0);
    for (int length = 1; length <= 100; ++length) {
        const std::vector<double> one = count_lengths({static_cast<double>(length)});
        size_t found = 0;
        for (size_t bin = 0; bin < one.size(); ++bin) {
            counts[bin] += one[bin];
            if (one[bin] != 1) continue;
            ++found;
            int first = 0, last = 0;  // read back from the label
            const int fields = std::sscanf(bin_label(bin).c_str(), "%d–%d", &first, &last);
            if (fields == 0) CHECK(bin_label(bin) == "≤ 5" && length <= 5);
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
    CHECK_EQUAL(most_likely(MoveShares{0.2, 0.3, 0.3}), size_t{1});
}

TEST(report_states_what_the_folders_hold) {
    const TemporaryFolder temporary;
    std::vector<std::string> folders;
    for (const int seed : {2, 0, 1})
        folders.push_back(write_run(temporary.path, "wodtem", seed, {{0, 9}, {900 + seed, 5}, {1100, 5}},
                                    "alpha = 0.5 # command line\n"));
    folders.push_back(write_run(temporary.path, "odt", 4, {{0, 100}, {1100, 7}}));
    folders.push_back(write_run(temporary.path, "odt", 0, {{0, 100}, {500, 100}}));
    std::filesystem::remove(folders.back() + "/finished");
    folders.push_back(write_run(temporary.path, "dt", 0, {{0, 14}}));

    const std::string out = temporary.path + "/out", text = report(folders, out);
    const std::string page = read_file(out + "/report.html"), markdown = read_file(out + "/report.md");
    for (const char* row :
         {"| WODTEM | 3 | 5.00 ± 0.00 | 6.33 ± 0.00 | 1.00 ± 0.00 | 3 of 3 | 5 (sec. V-D) |",
          "| ODT | 2 (1 unfinished) | 53.50 ± 65.76 | 76.75 ± 32.88 | 0.50 ± 0.71 | 0 of 2 | about 7 (sec. IV-A) |",
          "| DT | 1 | 14.00 ± - | 14.00 ± - | 1.00 ± - | 0 of 1 | no number (fig. 4a) |",
          "| WODTEM seed 2 | finished | 5.00 | 6.33 | 1.00 | 6 | 902 |",
          "| ODT seed 0 | unfinished, at 500 | 100.00 | 100.00 | 0.00 | 6 | never |",
          "| wodtem train gridworld --method wodtem --preset paper --seeds 0-2 --set alpha=0.5 | plain |",
          "| wodtem train gridworld --method odt --preset paper --seed 4 | plain |"})
        if (markdown.find(row) == std::string::npos) CHECK_EQUAL(row, "is not in " + markdown);
    CHECK(text.find("5.00 ± 0.00") != std::string::npos);
    for (const char* figure :
         {"length", "episodes", "start-odt", "start-wodtem", "grid-dt", "grid-odt", "grid-wodtem"}) {
        const std::string file = std::string("gridworld-paper-") + figure + ".svg",
                          svg_text = read_file(out + "/" + file);
        CHECK(page.find(svg_text) != std::string::npos);
        CHECK(markdown.find("![](" + file + ")") != std::string::npos);
        CHECK(svg_text.find("nan") == std::string::npos);
    }
    CHECK(page.find("They reach G in 5 steps.") != std::string::npos);
    CHECK(page.find("They do not reach G: after 5 steps") != std::string::npos);

    std::reverse(folders.begin(), folders.end());  // the order of the arguments does not matter
    report(folders, out);
    CHECK(read_file(out + "/report.html") == page);
}

TEST(report_of_a_run_that_has_just_begun_has_dashes) {
    const TemporaryFolder temporary;
    write(temporary.path + "/run", "settings",
          "task = gridworld # a\nmethod = odt # a\npreset = small # a\nseed = 3 # a\narithmetic = fused # a\n");
    report({temporary.path + "/run/"}, temporary.path + "/out");
    const std::string markdown = read_file(temporary.path + "/out/report.md");
    CHECK(markdown.find("| ODT | 1 (1 unfinished) | - | - | - | 0 of 1 |") != std::string::npos);
    CHECK(markdown.find("| ODT seed 3 | unfinished, at 0 | - | - | - | - |") != std::string::npos);
}

TEST(report_of_another_task_has_one_curve) {
    const TemporaryFolder temporary;
    const std::string folder = temporary.path + "/run";
    write(folder, "settings", "task = hopper-medium-v2 # a\nmethod = odt # a\npreset = paper # a\nseed = 0 # a\n");
    write(folder, "progress.csv",
          "interactions,eval_length,eval_return,eval_score\n0,900,2000,62.5\n5000,1000,3200,nan\n");
    write(folder, "episodes.csv", "interactions,length,return\n1000,1000,2000\n");
    write(folder, "finished", "");
    report({folder}, temporary.path + "/out");
    CHECK(read_file(temporary.path + "/out/report.md").find("| ODT | 1 | 3,200.00 ± - | 62.50 ± - |") !=
          std::string::npos);
    CHECK(read_file(temporary.path + "/out/hopper-medium-v2-paper-curve.svg").find("normalised score") !=
          std::string::npos);
}

TEST(report_names_each_way_a_folder_can_be_wrong) {
    const TemporaryFolder temporary;
    const std::string out = temporary.path + "/out", good = write_run(temporary.path, "odt", 0, {{0, 9}, {90, 5}});
    CHECK_FAILS("report.nothing", report({}, out));
    CHECK_FAILS("report.folder", report({temporary.path}, out));
    CHECK_FAILS("report.same_seed", report({good, good + "/"}, out));
    CHECK_FAILS("report.options",
                report({good, write_run(temporary.path, "odt", 1, {{0, 9}}, "K = 2 # command line\n")}, out));
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
    fails("report.setting", "settings", settings.substr(settings.find('\n') + 1));  // no task
    fails("report.setting", "settings", "task = ../x # a\nmethod = odt # a\npreset = p # a\nseed = 1 # a\n");
    fails("report.setting", "settings", "task = x # a\nmethod = sac # a\npreset = p # a\nseed = 1 # a\n");
    fails("report.setting", "settings", "task = x # a\nmethod = odt # a\npreset = p # a\nseed = 1x # a\n");
    fails("report.setting", "settings", settings + "edge = round # a\n");
    fails("csv.unfinished", "progress.csv", "interactions,eval_length,eval_return,eval_score\n0,9,1,1");
    fails("csv.fields", "progress.csv", "interactions,eval_length,eval_return,eval_score\n0,9,1\n");
    fails("csv.number", "progress.csv", "interactions,eval_length,eval_return,eval_score\n0,9,1,x\n");
    fails("csv.column", "progress.csv", "interactions,eval_length,eval_return\n0,9,1\n");
    fails("report.order", "progress.csv", "interactions,eval_length,eval_return,eval_score\n9,9,1,1\n8,9,1,1\n");
    fails("report.range", "progress.csv", "interactions,eval_length,eval_return,eval_score\nnan,9,1,1\n");
    fails("report.range", "episodes.csv", "interactions,length,return\n101,101,0\n");
    fails("report.range", "policy.csv", std::string(policy).replace(policy.find("0.65"), 4, "1.65"));
    fails("report.rows", "policy.csv", policy + "6,0,1,0,0,0,0,0,0,0\n");
    fails("report.rows", "policy.csv", policy.substr(0, policy.rfind("\n5,5") + 1));
    fails("report.rows", "start_actions.csv", std::string(start).replace(start.find("\nD,"), 3, "\nX,"));
    std::filesystem::remove(good + "/policy.csv");  // finished, so it must be there
    CHECK_FAILS("file.open", report({good}, out));
}
