// test_map.cpp: the map from the paper to the code. Every equation, every definition without a number and every row of
// Tables I and II has one implementation, a test and a golden vector. The map is made from these comments:
//
//   // WODTEM eq. (5): <formula>           above the code that training runs
//   // WODTEM eq. (5), plain: <formula>    above a second, plainer version of it, if there is one
//   // WODTEM sec. III-A, g_t: <formula>   above the code of a definition without a number
//   // WODTEM eq. (5) test                 above a test of it; and a golden vector's metadata names the equation
//   // departs from <paper or program>: <what the code does instead, and why>.
//
// Several tags of one place are separated by semicolons, and the colon follows the last. The tests hold README.md (the
// short table: one test for each equation) and data/CHOICES.md (the departures) to the comments. `make map` prints both
// tables as these files must hold them, and the long map with each formula and all tests: compiled with -DPRINT_MAP,
// this file is that program. Run from the root of the repository.
#include <filesystem>
#include <map>

#include "../data/safetensors.hpp"
#include "test.hpp"

namespace {

struct Item {
    const char* tag;      // after "WODTEM "
    const char* what;     // in a few words
    const char* vectors;  // topics; "": those whose metadata has the number; "none": no vector can show it
};

// In the paper's order. Between (3) and (5) the paper has two displays without a number: the update rule of Q, which we
// call eq. (4), and K(s_q), which goes by its section. Nor does the paper number the steps of sec. IV-B.3: "our step 1"
// to "our step 5" are our numbers, and the comments in the code may leave out "our".
const std::vector<Item> items = {
    {"sec. III-A, g_t", "return-to-go", "returns"},
    {"sec. III-A, d_t", "discounted return", "returns"},
    {"sec. III-A, D_online", "replay buffer, first in, first out", "sampling"},
    {"sec. III-B, g_{t+1}", "return-to-go while acting", "acting"},
    {"sec. III-B, C^t", "steps of a window", "sampling"},
    {"eq. (1)", "ODT's problem", ""},
    {"eq. (2)", "J, likelihood", ""},
    {"eq. (3)", "H-bar, entropy", ""},
    {"sec. IV-A", "grid world's data policy", "gridworld"},
    {"eq. (4)", "update of Q", ""},
    {"sec. IV-B.1, full table", "eviction", "memory_update"},
    {"sec. IV-B.1, projection", "R^F to R^F1", "initialisation"},
    {"sec. IV-B.2, q", "squared distance", "memory_lookup"},
    {"sec. IV-B.2, K(s_q)", "neighbours", "memory_lookup"},
    {"eq. (5)", "e-hat", ""},
    {"eq. (6)", "a-hat", ""},
    {"sec. IV-B.3, our step 1", "sample a batch", "sampling"},
    {"sec. IV-B.3, our step 2", "consult the memory", "memory_lookup, weights"},
    {"eq. (7)", "weight w", ""},
    {"eq. (8)", "WODTEM's problem", ""},
    {"eq. (9)", "L, weighted likelihood", ""},
    {"eq. (10)", "H-bar, entropy", ""},
    {"sec. IV-B.3, our step 3", "steps of theta and lambda", "step"},
    {"sec. IV-B.3, our step 4", "offline phase", "none"},
    {"sec. IV-B.3, our step 5", "online phase", "none"},
    {"Table I", "settings, grid world", "none"},
    {"Table II", "settings, maze2d", "none"},
};

// The rows that both tables have: a setting's source names the table and the row.
const char* const table_rows[] = {"number of layers",
                                  "number of attention heads",
                                  "embedding dimension",
                                  "context length",
                                  "weight decay",
                                  "learning rate",
                                  "offline training updates",
                                  "online training updates per iteration",
                                  "buffer size",
                                  "position",
                                  "g_online",
                                  "g_eval"};

struct Source {
    std::string path;
    std::vector<std::string> lines;
};

std::vector<Source> sources(const std::vector<std::string>& folders, const std::string& start) {
    std::vector<std::string> paths;
    for (const std::string& folder : folders)
        for (const auto& entry : std::filesystem::directory_iterator(folder)) {
            const std::string name = entry.path().filename();
            if (name.starts_with(start) && name != "test_map.cpp" && (name.ends_with(".hpp") || name.ends_with(".cpp")))
                paths.push_back(folder == "." ? name : folder + "/" + name);
        }
    std::sort(paths.begin(), paths.end());
    std::vector<Source> all;
    for (const std::string& path : paths) {
        std::istringstream text(read_file(path));
        all.push_back({path, {}});
        for (std::string line; std::getline(text, line);) all.back().lines.push_back(line);
    }
    return all;
}

std::vector<Source> code() { return sources({".", "data"}, ""); }
std::vector<Source> tests() { return sources({"tests"}, "test_"); }

size_t indentation(const std::string& line) { return std::min(line.find_first_not_of(' '), line.size()); }
bool is_comment(const std::string& line) { return line.compare(indentation(line), 2, "//") == 0; }

// The name that a line begins to define: of a function, a type, an enumeration or a table; "" if it defines none.
std::string defined_name(const std::string& line) {
    const size_t comment = line.find("  //");
    std::string text = line.substr(0, comment).substr(std::min(indentation(line), comment));
    for (const char* word : {"struct ", "class ", "enum class "})
        if (text.starts_with(word) && text.find('{') != std::string::npos) {
            text = text.substr(std::strlen(word));
            return text.substr(0, text.find_first_of(" :{"));
        }
    for (const char* word :
         {"return ", "if ", "for ", "while ", "switch ", "else", "//", "#", "}", "template", "const auto"})
        if (text.starts_with(word)) return "";
    size_t end = text.find('(');
    for (const char* table : {" = {", "{{", "[]"})
        if (const size_t length = std::strlen(table); text.ends_with(table)) {
            end = text.size() - length;
            text.resize(end);
        }
    if (end == std::string::npos || text.ends_with(";") || text.find('=') < end) return "";
    const size_t begin = text.find_last_of(" *&", end - 1);
    if (begin == std::string::npos) return std::isupper(text[0]) ? text.substr(0, end) : "";  // a constructor
    return text.substr(begin + 1, end - begin - 1);
}

// What a comment at `at` stands above, or else in.
std::string place(const Source& source, size_t at) {
    size_t next = at;
    const auto skipped = [&](const std::string& line) {
        return is_comment(line) || line.find("template <") != std::string::npos || line.starts_with("requires");
    };
    while (next < source.lines.size() && skipped(source.lines[next])) ++next;
    const size_t depth = indentation(source.lines[at]);
    std::string name =
        is_comment(source.lines[at]) && next < source.lines.size() ? defined_name(source.lines[next]) : "";
    for (size_t i = at; name.empty() && i-- > 0;)
        if (indentation(source.lines[i]) < depth) name = defined_name(source.lines[i]);
    return "`" + source.path + "`: `" + name + "`";
}

using Place = std::pair<const Source*, size_t>;  // a file and the index of a line

// The places of a tag: "WODTEM " and the tag, whole, and after it `follows`, or other tags and then `follows`.
std::vector<Place> find_tag(const std::vector<Source>& in, const std::string& tag, const std::string& follows) {
    std::vector<Place> found;
    for (const Source& source : in)
        for (size_t i = 0; i < source.lines.size(); ++i) {
            const std::string& line = source.lines[i];
            const size_t at = line.find("WODTEM " + tag);
            if (at == std::string::npos) continue;
            std::string rest = line.substr(at + 7 + tag.size());
            while (rest.starts_with("; WODTEM "))
                rest = rest.substr(std::min(rest.find_first_of(";:", 9), rest.size()));
            if (rest.starts_with(follows)) found.push_back({&source, i});
        }
    if (const size_t our = tag.find("our step"); found.empty() && our != std::string::npos)
        return find_tag(in, tag.substr(0, our) + tag.substr(our + 4), follows);
    return found;
}

// The name of the TEST that follows.
std::string test_name(const Place& tag) {
    const std::vector<std::string>& lines = tag.first->lines;
    for (size_t i = tag.second; i < lines.size(); ++i)
        if (lines[i].starts_with("TEST(")) return lines[i].substr(5, lines[i].find(')') - 5);
    return "";
}

// A comment's text from column `from` of line `at` on, to the end of the comment or, if `stop`, to a full stop.
std::string comment_text(const Source& source, size_t at, size_t from, bool stop) {
    std::string text = source.lines[at].substr(from);
    const size_t depth = indentation(source.lines[at]);
    for (size_t next = at + 1; next < source.lines.size(); ++next) {
        const std::string& line = source.lines[next];
        if ((stop && text.ends_with(".")) || !is_comment(source.lines[at]) || !is_comment(line)) break;
        if (indentation(line) != depth || line.find("// WODTEM ") != std::string::npos) break;
        text += line.substr(depth + 2);
    }
    return text;
}

// Equations of each golden vector file, by the file's topic.
std::map<std::string, std::string> vector_equations() {
    std::map<std::string, std::string> equations;
    for (const auto& entry : std::filesystem::directory_iterator("tests/vectors"))
        if (entry.path().extension() == ".safetensors") {
            const TensorFile file = read_safetensors(entry.path());
            equations[entry.path().stem()] = file.text("equations");
        }
    return equations;
}

// A | inside a cell of a table.
std::string cell(std::string text) {
    for (size_t at = 0; (at = text.find('|', at)) != std::string::npos; at += 2) text.insert(at, 1, '\\');
    return text;
}

// The cells of a row of a table: "| a | b |" is {"a", "b"}.
std::vector<std::string> cells(const std::string& row) {
    std::vector<std::string> all;
    for (size_t begin = 2, end; (end = row.find(" |", begin)) != std::string::npos; begin = end + 3)
        all.push_back(row.substr(begin, end - begin));
    return all;
}

std::vector<std::string> lines_of(const std::string& path) {
    std::istringstream text(read_file(path));
    std::vector<std::string> lines;
    for (std::string line; std::getline(text, line);) lines.push_back(line);
    return lines;
}

std::string code_span(const std::string& name) { return "`" + name + "`"; }

std::string list(const std::vector<std::string>& names) {
    std::string text;
    for (const std::string& name : names) text += (text.empty() ? "" : ", ") + code_span(name);
    return text;
}

// What the comments and the vectors say about one item.
struct Entry {
    std::string tag, what, code, formula, plain;  // code, plain: "`FILE`: `FUNCTION`"
    std::vector<std::string> tests, vectors;
    std::string no_vector;  // "none", or nothing
};

// The whole map, and the problems found on the way.
std::vector<Entry> equation_map(std::vector<std::string>& problems) {
    const std::vector<Source> all_code = code(), all_tests = tests();
    const std::map<std::string, std::string> vectors = vector_equations();
    std::vector<Entry> map;
    for (const Item& item : items) {
        const std::string tag = item.tag, topics = item.vectors;
        Entry entry{tag, item.what, "", "", "", {}, {}, topics.starts_with("none") ? topics : ""};

        const std::vector<Place> in_code = find_tag(all_code, tag, ":");
        if (in_code.empty()) problems.push_back("no code has the tag \"WODTEM " + tag + ":\"");
        if (in_code.size() > 1 && !tag.starts_with("Table"))
            problems.push_back("more than one place has the tag \"WODTEM " + tag + ":\", the last in " +
                               in_code.back().first->path + ":" + std::to_string(in_code.back().second + 1) +
                               "; a plain version has the tag \"WODTEM " + tag + ", plain:\"");
        if (!in_code.empty()) {
            const auto& [source, line] = in_code[0];
            entry.code = place(*source, line);
            const size_t colon = source->lines[line].find(": ", source->lines[line].rfind("WODTEM "));
            if (colon != std::string::npos) {
                entry.formula = comment_text(*source, line, colon + 2, false);
                entry.formula = entry.formula.substr(0, entry.formula.find(" departs from "));
            }
            if (entry.code.ends_with("``"))
                problems.push_back("cannot tell where \"WODTEM " + tag + ":\" is: " + entry.code);
        }
        for (const auto& [source, line] : find_tag(all_code, tag, ", plain:")) entry.plain = place(*source, line);

        for (const Place& test : find_tag(all_tests, tag, " test"))
            if (const std::string name = test_name(test);
                std::find(entry.tests.begin(), entry.tests.end(), name) == entry.tests.end())
                entry.tests.push_back(name);
        if (entry.tests.empty()) problems.push_back("no test has the tag \"WODTEM " + tag + " test\"");

        for (const auto& [topic, equations] : vectors)
            if (topics.empty() ? equations.find(tag.substr(tag.find('('))) != std::string::npos
                               : (", " + topics + ",").find(" " + topic + ",") != std::string::npos)
                entry.vectors.push_back(topic);
        if (entry.vectors.empty() && entry.no_vector.empty())
            problems.push_back("no golden vector for \"WODTEM " + tag + "\"");
        map.push_back(entry);
    }
    for (const std::string table : {"Table I: ", "Table II: "})
        for (const char* row : table_rows)
            if (find_tag(all_code, table + row, "").empty())
                problems.push_back("no setting has the source \"WODTEM " + table + row + "\"");
    return map;
}

// The row of README.md's table. README.md chooses the words of the second cell and which of the tests it names, so both
// are kept where the row `found` there has them.
std::string readme_row(const Entry& entry, const std::vector<std::string>& found) {
    std::string what = entry.what, test = entry.tests.empty() ? "" : entry.tests[0];
    if (found.size() == 5) {
        what = found[1];
        for (const std::string& name : entry.tests)
            if (found[3] == code_span(name)) test = name;
    }
    return "| " + entry.tag + " | " + what + " | " + entry.code + " | " + code_span(test) + " | " +
           (entry.no_vector.empty() ? list(entry.vectors) : entry.no_vector) + " |";
}

constexpr const char* readme_head = "| paper | what | code | test | vector |";

// README.md's table as it should be, and as it is.
std::pair<std::vector<std::string>, std::vector<std::string>> readme_rows() {
    std::vector<std::string> problems, wanted, found;
    const std::vector<std::string> lines = lines_of("README.md");
    const auto head = std::find(lines.begin(), lines.end(), readme_head);
    for (auto line = head; line != lines.end() && line->starts_with("| "); ++line)
        if (line != head && !line->starts_with("| --- ")) found.push_back(*line);
    for (const Entry& entry : equation_map(problems)) {
        std::vector<std::string> row;
        for (const std::string& line : found)
            if (line.starts_with("| " + entry.tag + " |")) row = cells(line);
        wanted.push_back(readme_row(entry, row));
    }
    return {wanted, found};
}

// The rows of data/CHOICES.md's table of departures.
std::vector<std::string> departure_rows(std::vector<std::string>& problems) {
    const std::string mark = "// departs from ";
    std::vector<std::string> rows;
    for (const Source& source : code())
        for (size_t i = 0; i < source.lines.size(); ++i) {
            const size_t at = source.lines[i].find(mark);
            if (at == std::string::npos) continue;
            const std::string sentence = comment_text(source, i, at + mark.size(), true);
            const size_t colon = sentence.find(": ");
            if (colon == std::string::npos)
                problems.push_back(source.path + ":" + std::to_string(i + 1) +
                                   ": \"departs from\" without \": reason\"");
            else
                rows.push_back("| " + sentence.substr(0, colon) + " | " + cell(sentence.substr(colon + 2)) + " | " +
                               place(source, i) + " |");
        }
    return rows;
}

}  // namespace

#ifdef PRINT_MAP
int main() {
    std::vector<std::string> problems;
    std::printf("README.md:\n\n%s\n| --- | --- | --- | --- | --- |\n", readme_head);
    for (const std::string& row : readme_rows().first) std::printf("%s\n", row.c_str());
    std::printf("\ndata/CHOICES.md:\n\n| departs from | what, and why | where |\n| --- | --- | --- |\n");
    for (const std::string& row : departure_rows(problems)) std::printf("%s\n", row.c_str());
    std::printf("\nThe long map:\n");
    for (const Entry& entry : equation_map(problems)) {
        std::printf("\n%s: %s\n  %s\n  code:    %s\n", entry.tag.c_str(), entry.what.c_str(), entry.formula.c_str(),
                    entry.code.c_str());
        if (!entry.plain.empty()) std::printf("  plain:   %s\n", entry.plain.c_str());
        for (const std::string& test : entry.tests) std::printf("  test:    build/tests %s\n", test.c_str());
        for (const std::string& topic : entry.vectors)
            std::printf("  vector:  wodtem check -v tests/vectors/%s.safetensors\n", topic.c_str());
        if (!entry.no_vector.empty()) std::printf("  vector:  %s\n", entry.no_vector.c_str());
    }
    for (const std::string& problem : problems) std::fprintf(stderr, "%s\n", problem.c_str());
    return problems.empty() ? 0 : 1;
}
#else

TEST(every_equation_has_one_place_in_the_code_a_test_and_a_vector) {
    std::vector<std::string> problems;
    equation_map(problems);
    for (const std::string& problem : problems) report_failure(__FILE__, __LINE__, problem);
}

TEST(the_readme_maps_each_equation_to_its_code_a_test_and_its_vectors) {
    const auto [wanted, found] = readme_rows();
    for (const std::string& row : wanted)
        if (std::find(found.begin(), found.end(), row) == found.end())
            report_failure("README.md", 0, "the table lacks this row (`make map` prints all): " + row);
    for (const std::string& row : found)
        if (std::find(wanted.begin(), wanted.end(), row) == wanted.end())
            report_failure("README.md", 0, "the code has nothing for this row of the table: " + row);
    CHECK_EQUAL(found.size(), items.size());
}

TEST(the_page_of_choices_lists_every_departure_in_the_code) {
    std::vector<std::string> problems;
    const std::vector<std::string> lines = lines_of("data/CHOICES.md");
    size_t rows = 0;
    for (const std::string& row : departure_rows(problems)) {
        if (std::find(lines.begin(), lines.end(), row) == lines.end())
            report_failure("data/CHOICES.md", 0, "lacks this row (`make map` prints all): " + row);
        ++rows;
    }
    for (const std::string& problem : problems) report_failure(__FILE__, __LINE__, problem);
    const auto head = std::find(lines.begin(), lines.end(), "| departs from | what, and why | where |");
    auto line = head;
    while (line != lines.end() && line->starts_with("| ")) ++line;
    CHECK_EQUAL(static_cast<size_t>(line - head), rows + 2);  // and no row that the code does not have
}

// A newcomer has an hour.
TEST(the_readme_is_short_and_names_every_source_file) {
    const std::string readme = read_file("README.md");
    CHECK(readme.size() <= 16384);
    CHECK(lines_of("README.md").size() <= 220);
    for (const Source& source : code()) {
        const std::string name = source.path.substr(source.path.find('/') + 1);  // without "data/"
        if (readme.find(code_span(name)) == std::string::npos)
            report_failure("README.md", 0, "does not name " + source.path);
    }
}

TEST(links_between_pages_lead_to_files) {
    std::vector<std::string> pages;
    for (const std::string folder : {".", "data", "tests", "tests/vectors"})
        for (const auto& entry : std::filesystem::directory_iterator(folder))
            if (entry.path().extension() == ".md") pages.push_back(entry.path());
    CHECK(pages.size() >= 7);
    for (const std::string& page : pages) {
        const std::string text = read_file(page);
        for (size_t at = 0; (at = text.find("](", at)) != std::string::npos; ++at) {
            const std::string target = text.substr(at + 2, text.find_first_of("#) \n", at + 2) - at - 2);
            if (target.empty() || target.find("://") != std::string::npos) continue;
            if (!std::filesystem::exists(std::filesystem::path(page).parent_path() / target))
                report_failure(page.c_str(), 0, "a link leads to " + target + ", which is not there");
        }
    }
}

// The list of mistakes that `make mutants` tries one by one cannot rot: each must fit the code, in one place.
TEST(every_mutant_fits_the_code_in_exactly_one_place) {
    std::istringstream list(read_file("tests/mutants.txt"));
    std::map<std::string, std::string> text;
    std::vector<std::string> names;
    for (std::string line; std::getline(list, line);) {
        if (line.empty() || line[0] == '#') continue;
        const size_t file_at = line.find(": ") + 2, code_at = line.find(": ", file_at) + 2;
        const std::string name = line.substr(0, file_at - 2), file = line.substr(file_at, code_at - 2 - file_at);
        std::string code = line.substr(code_at);
        for (size_t at; (at = code.find("\\n")) != std::string::npos;) code.replace(at, 2, "\n");
        const size_t open = code.find("<<<"), arrow = code.find(" ==> "), shut = code.find(">>>");
        CHECK(open < arrow && arrow < shut && shut != std::string::npos);
        code = code.substr(0, open) + code.substr(open + 3, arrow - open - 3) + code.substr(shut + 3);
        if (!text.contains(file)) text[file] = read_file(file);
        const size_t at = text[file].find(code);
        if (at == std::string::npos) report_failure("tests/mutants.txt", 0, name + " does not fit " + file);
        if (at != std::string::npos && text[file].find(code, at + 1) != std::string::npos)
            report_failure("tests/mutants.txt", 0, name + " fits " + file + " in more than one place");
        CHECK(std::find(names.begin(), names.end(), name) == names.end());
        names.push_back(name);
    }
    CHECK(names.size() >= 80);
}

#endif
