// test_map.cpp: the map from the paper to the code. Every equation, every definition without a number, every row of
// Tables I and II has one implementation, a test and a golden vector, under one greppable form:
//
//   // WODTEM eq. (5): <formula>           above the code
//   // WODTEM sec. III-A, g_t: <formula>   the same, of what has no number
//   // WODTEM eq. (5) test                 above its test; and a vector's metadata names the equation
//   // departs from <paper or program>: <what we do instead, and why>.
//
// Several tags of one place are separated by semicolons, the colon follows the last. `make map` prints the tables that
// README.md must hold; compiled with -DPRINT_MAP this file is that program. Run from the root of the repository.
#include <filesystem>
#include <map>

#include "../data/safetensors.hpp"
#include "test.hpp"

namespace {

struct Item {
    const char* tag;        // after "WODTEM "
    const char* statement;  // in ASCII
    const char* vectors;    // topics; "": those whose metadata has the number; "none: why"
};

// In the paper's order. Its text as we have it lost the number (4): we give it to the update rule between (3) and (5).
// The steps of sec. IV-B.3 are numbered here; the paper has no algorithm box.
const std::vector<Item> items = {
    {"sec. III-A, g_t", "g_t = r_t + ... + r_T", "returns"},
    {"sec. III-A, d_t", "d_t = r_t + gamma r_{t+1} + ... + gamma^(T-t) r_T", "returns"},
    {"sec. III-A, D_online", "first in, first out", "sampling"},
    {"sec. III-B, g_{t+1}", "g_{t+1} = g_t - r_t while acting", "none: a loop with an environment"},
    {"sec. III-B, C^t", "the steps of a sub-trajectory, at most C", "sampling"},
    {"eq. (1)", "max over lambda >= 0, min over theta of J + lambda (eta - H-bar)", ""},
    {"eq. (2)", "J = E[ -1/|C^t| sum_c log pi(a_c) ]", ""},
    {"eq. (3)", "H-bar = E[ 1/|C^t| sum_c H(pi) ]", ""},
    {"sec. IV-A", "the behaviour policy of the data set", "gridworld"},
    {"eq. (4)", "Q(s) keeps the highest d and its action", ""},
    {"sec. IV-B.1, full table", "the least frequently accessed entry goes", "memory_update"},
    {"sec. IV-B.1, projection", "R^F to R^F1, at random", "none: random numbers times states; rng has those"},
    {"sec. IV-B.2, q", "q(s_q, s_k) = ||s_q - s_k||^2", "memory_lookup"},
    {"sec. IV-B.2, K(s_q)", "the K closest entries, those with q < epsilon", "memory_lookup"},
    {"eq. (5)", "e-hat = sum_k exp(-q_k) e_k / sum_k exp(-q_k)", ""},
    {"eq. (6)", "a-hat = a_k with probability exp(e_k) / sum_k exp(e_k)", ""},
    {"sec. IV-B.3, step 1", "sample (s, a, g, d)", "sampling"},
    {"sec. IV-B.3, step 2", "look up s_c: K(s_c); weigh (s_c, a_c); below e-hat draw a-hat(s_c)",
     "memory_lookup, weights"},
    {"eq. (7)", "w = 1 if d >= e-hat, else alpha", ""},
    {"eq. (8)", "max over lambda >= 0, min over theta of L + lambda (eta - H-bar)", ""},
    {"eq. (9)", "L = E[ -1/|C^t| sum_c (w log pi(a_c) + (1 - w) log pi(a-hat)) ]", ""},
    {"eq. (10)", "H-bar = E[ 1/|C^t| sum_c H(pi) ]", ""},
    {"sec. IV-B.3, step 3", "one step of theta, one of lambda, in turns", "step"},
    {"sec. IV-B.3, step 4", "first offline, on D_offline", "none: a loop of updates"},
    {"sec. IV-B.3, step 5", "then online: an episode into D and Q, updates", "none: a loop of episodes and updates"},
    {"Table I", "settings of the grid world", "none: numbers"},
    {"Table II", "settings of maze2d", "none: numbers"},
};

// The rows of the two tables: the setting's source names the row.
const char* const table_rows[] = {"Table I: number of layers",
                                  "Table I: number of attention heads",
                                  "Table I: embedding dimension",
                                  "Table I: context length",
                                  "Table I: weight decay",
                                  "Table I: learning rate",
                                  "Table I: offline training updates",
                                  "Table I: online training updates per iteration",
                                  "Table I: buffer size",
                                  "Table I: position",
                                  "Table I: g_online",
                                  "Table I: g_eval",
                                  "Table II: number of layers",
                                  "Table II: number of attention heads",
                                  "Table II: embedding dimension",
                                  "Table II: context length",
                                  "Table II: weight decay",
                                  "Table II: learning rate",
                                  "Table II: offline training updates",
                                  "Table II: online training updates per iteration",
                                  "Table II: buffer size",
                                  "Table II: position",
                                  "Table II: g_online",
                                  "Table II: g_eval"};

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

// The name that a line begins to define: of a function, an enumeration or a table; "" if it defines none.
std::string defined_name(const std::string& line) {
    const size_t comment = line.find("  //");
    const std::string text = line.substr(0, comment).substr(std::min(indentation(line), comment));
    for (const char* word :
         {"return ", "if ", "for ", "while ", "switch ", "else", "//", "#", "}", "template", "const auto"})
        if (text.starts_with(word)) return "";
    size_t end = std::min(text.find('('), text.find("[] = {"));
    if (text.starts_with("enum class ") || text.starts_with("struct ")) end = text.find(" {");
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

// The places of a tag: "WODTEM " and the tag, whole, and after it `follows`, or other tags and then `follows`.
std::vector<std::pair<const Source*, size_t>> find_tag(const std::vector<Source>& in, const std::string& tag,
                                                       const std::string& follows) {
    std::vector<std::pair<const Source*, size_t>> found;
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
    return found;
}

// The name of the TEST that follows.
std::string test_name(const Source& source, size_t at) {
    for (; at < source.lines.size(); ++at)
        if (source.lines[at].starts_with("TEST(")) return source.lines[at].substr(5, source.lines[at].find(')') - 5);
    return "";
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

void append(std::string& list, const std::string& name) {
    if (list.find("`" + name + "`") == std::string::npos) list += (list.empty() ? "`" : ", `") + name + "`";
}

// What `make map` prints, and the problems found on the way.
std::string equation_map(std::vector<std::string>& problems) {
    const std::vector<Source> all_code = code(), all_tests = tests();
    const std::map<std::string, std::string> vectors = vector_equations();
    std::string text = "| paper | what | where | test | vector |\n| --- | --- | --- | --- | --- |\n";
    for (const Item& item : items) {
        const std::string tag = item.tag;
        const bool table = tag.starts_with("Table");
        const auto in_code = find_tag(all_code, tag, ":");
        if (in_code.empty()) problems.push_back("no code has the tag \"WODTEM " + tag + ":\"");
        if (in_code.size() > 1 && !table)
            problems.push_back("more than one place has the tag \"WODTEM " + tag + ":\", the last in " +
                               in_code.back().first->path + ":" + std::to_string(in_code.back().second + 1));
        std::string test_list, vector_list;
        for (const auto& [source, line] : find_tag(all_tests, tag, " test"))
            append(test_list, test_name(*source, line));
        if (test_list.empty()) problems.push_back("no test has the tag \"WODTEM " + tag + " test\"");
        for (const auto& [topic, equations] : vectors)
            if (*item.vectors == 0
                    ? equations.find(tag.substr(tag.find('('))) != std::string::npos
                    : (", " + std::string(item.vectors) + ",").find(" " + topic + ",") != std::string::npos)
                append(vector_list, topic);
        const std::string none = std::string(item.vectors).starts_with("none: ") ? item.vectors : "";
        if (vector_list.empty() && none.empty()) problems.push_back("no golden vector for \"WODTEM " + tag + "\"");
        std::string where = in_code.empty() ? "" : place(*in_code[0].first, in_code[0].second);
        if (where.ends_with("``")) problems.push_back("cannot tell where \"WODTEM " + tag + ":\" is: " + where);
        text += "| " + tag + " | " + cell(item.statement) + " | " + where + " | " + test_list + " | " +
                (none.empty() ? vector_list : none) + " |\n";
    }
    for (const char* row : table_rows)
        if (find_tag(all_code, row, "").empty())
            problems.push_back(std::string("no setting has the source \"WODTEM ") + row + "\"");
    text += "\n| departs from | what, and why | where |\n| --- | --- | --- |\n";
    for (const Source& source : all_code)
        for (size_t i = 0; i < source.lines.size(); ++i) {
            const size_t at = source.lines[i].find("// departs from ");
            if (at == std::string::npos) continue;
            std::string sentence = source.lines[i].substr(at + 16);
            for (size_t next = i + 1; !sentence.ends_with(".") && next < source.lines.size() &&
                                      indentation(source.lines[i]) == at && is_comment(source.lines[next]);
                 ++next)
                sentence += source.lines[next].substr(indentation(source.lines[next]) + 2);
            const size_t colon = sentence.find(": ");
            if (colon == std::string::npos)
                problems.push_back(source.path + ":" + std::to_string(i + 1) +
                                   ": \"departs from\" without \": reason\"");
            else
                text += "| " + sentence.substr(0, colon) + " | " + sentence.substr(colon + 2) + " | " +
                        place(source, i) + " |\n";
        }
    return text;
}

}  // namespace

#ifdef PRINT_MAP
int main() {
    std::vector<std::string> problems;
    std::printf("%s", equation_map(problems).c_str());
    for (const std::string& problem : problems) std::fprintf(stderr, "%s\n", problem.c_str());
    return problems.empty() ? 0 : 1;
}
#else

TEST(every_equation_has_one_place_in_the_code_a_test_and_a_vector) {
    std::vector<std::string> problems;
    equation_map(problems);
    for (const std::string& problem : problems) report_failure(__FILE__, __LINE__, problem);
}

TEST(the_readme_holds_what_make_map_prints) {
    std::vector<std::string> problems;
    if (read_file("README.md").find("\n" + equation_map(problems)) == std::string::npos)
        report_failure("README.md", 0, "does not hold, word for word, what `make map` prints; put it there");
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
