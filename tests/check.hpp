// check.hpp: `wodtem check FILE...` recomputes golden vectors with the functions that training uses, and compares.
// Included by wodtem.cpp. tests/vectors/README.md describes the files, well enough to write new ones by hand.
//
// In order: cases (inputs by name; outputs are compared with the file's, each within its stated tolerance); one
// function for each topic, in porting order; the table of topics; files.
// Promises: files are untrusted. What is missing, unknown, of another shape or not counted is reported in a sentence
// with file, tensor and offset. Every size and setting of a case comes from the file and is held to a range. Where the
// code is templated on the scalar, a case is computed in double and in float.
// Leaves out: making vectors, which tests/vectors/peer.py does and shares no code with this.
// Words: in messages "file" is the number that the vector file holds, "wodtem" the one that this program computes.
#pragma once

#include "chain_statistics.hpp"
#include "plain.hpp"

namespace vectors {

// ---------------------------------------------------------------------------------------------------------------------
// Cases

enum class Precision { float64, float32 };

// |wodtem - file| <= bound * (largest |file| of the tensor) + absolute; exact: equal numbers.
struct Tolerance {
    bool exact = false;
    double float64 = 1e-10, float32 = 1e-5, absolute = 0;
};

// Reads "exact: REASON" or "float64 1e-12, float32 3e-6, absolute 1e-9: REASON", any of the three words, once each.
// Errors: check.tolerance.
Tolerance parse_tolerance(const std::string& text, const std::string& where) {
    Tolerance tolerance;
    const size_t colon = text.find(':');
    bool good = colon != std::string::npos;
    if (good && text.substr(0, colon) == "exact") return {true, 0, 0, 0};
    std::map<std::string, double*> words = {
        {"float64", &tolerance.float64}, {"float32", &tolerance.float32}, {"absolute", &tolerance.absolute}};
    for (const std::string& item : split(text.substr(0, colon), ',')) {
        std::vector<std::string> parts = split(item, ' ');
        std::erase(parts, "");
        const auto word = parts.size() == 2 ? words.find(parts[0]) : words.end();
        const auto x = parts.size() == 2 ? to_number(parts[1]) : std::nullopt;
        good = good && word != words.end() && x && *x >= 0;
        if (!good) break;
        *word->second = *x;
        words.erase(word);
    }
    require(good, "check.tolerance", where, " is ", json_string(text.substr(0, 80)),
            ", expected \"exact: REASON\", or any of these with a colon after the last: \"float64 1e-12, float32 1e-6, "
            "absolute 0: REASON\"");
    return tolerance;
}

constexpr uint64_t any = ~uint64_t{0};  // in a pattern of shapes

template <class T>
struct Array {
    Shape shape;
    std::vector<T> values;
    int extent(size_t axis) const { return static_cast<int>(shape[axis]); }
    int back() const { return static_cast<int>(shape.back()); }
};

std::string shown(long double x) {
    if (std::isnan(x)) return "nan";  // of either sign
    char text[48];
    std::snprintf(text, sizeof text, "%.17Lg", x);
    return text;
}

// The indices of an element as text, "[1, 2]".
std::string place(const Shape& shape, size_t at) {
    std::string text;
    for (size_t axis = shape.size(); axis-- > 0; at /= shape[axis])
        text = std::to_string(at % shape[axis]) + (text.empty() ? "" : ", ") + text;
    return "[" + text + "]";
}

// A case that is being recomputed.
struct Case {
    const TensorFile& file;
    std::string name;
    Compute& compute;
    bool verbose;
    Precision precision = Precision::float64;  // of what is computed now
    bool rounded = false;                      // an input was no float32
    double worst = 0;                          // largest |wodtem - file| as a part of what is allowed
    std::set<std::string> used = {};           // tensors and metadata entries that the topic has read
    std::vector<std::string> problems = {};    // what does not hold

    std::string where(const StoredTensor& tensor) const {
        return file.path + ": tensor " + json_string(tensor.name) + " at byte " +
               std::to_string(file.data_start + tensor.begin);
    }

    const StoredTensor* find(const std::string& tensor) {
        used.insert(name + "/" + tensor);
        const auto found = file.index.find(name + "/" + tensor);
        return found == file.index.end() ? nullptr : &file.tensors[found->second];
    }
    size_t array_size(const std::string& tensor) {
        const StoredTensor& found = need(tensor);
        return found.size / about(found.dtype).size;
    }
    bool has(const std::string& tensor) const { return file.has(name + "/" + tensor); }
    // The names of the case's tensors that begin with `start`, each without that beginning.
    std::set<std::string> named(const std::string& start) const {
        std::set<std::string> names;
        const std::string whole = name + "/" + start;
        for (auto i = file.index.lower_bound(whole); i != file.index.end() && i->first.starts_with(whole); ++i)
            names.insert(i->first.substr(whole.size()));
        return names;
    }

    const StoredTensor& need(const std::string& tensor) {
        const StoredTensor* found = find(tensor);
        require(found, "check.missing", file.path, ": case ", json_string(name), " has no tensor ",
                json_string(name + "/" + tensor), "; tests/vectors/README.md lists what its topic needs");
        return *found;
    }
    // Errors: check.value, unless the condition holds.
    void require_value(bool holds, const auto&... parts) const {
        require(holds, "check.value", file.path, ": case ", name, ": ", parts...);
    }

    void check_shape(const StoredTensor& tensor, const Shape& pattern) const {
        bool fits = tensor.shape.size() == pattern.size();
        const uint64_t most =
            tensor.size == 0 ? 1 << 20 : (uint64_t{1} << 31) - 1;  // an empty tensor may not claim billions of rows
        for (size_t i = 0; fits && i < pattern.size(); ++i)
            fits = tensor.shape[i] <= most && (pattern[i] == any || pattern[i] == tensor.shape[i]);
        if (pattern.empty()) fits = tensor.size == about(tensor.dtype).size;  // a number may have any rank
        if (fits) return;
        std::string expected = shape_text(pattern);
        for (size_t at; (at = expected.find(std::to_string(any))) != std::string::npos;)
            expected.replace(at, std::to_string(any).size(), "any");
        fail("check.shape", "%s: has shape %s, expected %s", where(tensor).c_str(), shape_text(tensor.shape).c_str(),
             expected.c_str());
    }

    // An input in the type of the computation. What float cannot hold is rounded; where the code has two precisions the
    // case is then computed in float alone, and where it has one the tolerance of float32 holds.
    template <class T>
    Array<T> in(const std::string& tensor_name, const Shape& pattern) {
        const StoredTensor& tensor = need("in/" + tensor_name);
        check_shape(tensor, pattern);
        Array<T> array = {tensor.shape, {}};
        for (const long double x : file.numbers<long double>(tensor)) {
            const T value = array.values.emplace_back(static_cast<T>(x));
            rounded |= std::is_same_v<T, float> && static_cast<long double>(value) != x && !std::isnan(x);
        }
        return array;
    }

    [[noreturn]] void refuse_entry(const std::string& tensor_name, size_t at, const std::string& expected) {
        const StoredTensor& tensor = need("in/" + tensor_name);
        fail("check.value", "%s: entry %s is %s, expected %s", where(tensor).c_str(), place(tensor.shape, at).c_str(),
             shown(file.numbers<long double>(tensor)[at]).c_str(), expected.c_str());
    }

    template <class T>
    Array<T> in_range(const std::string& tensor_name, const Shape& pattern, T low, T high, const char* range) {
        const Array<T> array = in<T>(tensor_name, pattern);
        for (size_t i = 0; i < array.values.size(); ++i)
            if (!(array.values[i] >= low && array.values[i] <= high))
                refuse_entry(tensor_name, i, std::string("a number ") + range);
        return array;
    }
    // Random numbers in [0, 1).
    Array<double> uniform_in(const std::string& tensor_name, const Shape& pattern) {
        return in_range(tensor_name, pattern, 0.0, 1 - 0x1p-53, "from 0, below 1");
    }

    // Whole numbers from low to high.
    Array<int64_t> whole_in(const std::string& tensor_name, const Shape& pattern, int64_t low, int64_t high) {
        const Array<long double> array = in<long double>(tensor_name, pattern);
        Array<int64_t> whole = {array.shape, {}};
        for (const long double x : array.values) {
            if (!(x >= static_cast<long double>(low) && x <= static_cast<long double>(high) && x == std::floor(x)))
                refuse_entry(tensor_name, whole.values.size(),
                             "a whole number from " + std::to_string(low) + " to " + std::to_string(high));
            whole.values.push_back(static_cast<int64_t>(x));
        }
        return whole;
    }

    // An input that may be left out.
    template <class T>
    Array<T> in_or(const std::string& tensor_name, const Shape& pattern, T fallback) {
        if (has("in/" + tensor_name)) return in<T>(tensor_name, pattern);
        size_t size = 1;
        for (const uint64_t extent : pattern) size *= extent;
        return {pattern, std::vector<T>(size, fallback)};
    }

    // A setting: tensor CASE/in/NAME of one element, or metadata entry CASE.NAME. Without a fallback it is needed.
    double number(const std::string& setting, std::optional<double> fallback, double low, double high) {
        double x = 0;
        const std::string key = name + "." + setting;
        const auto text = file.metadata.find(key);
        used.insert(key);
        std::string place = file.path + ": metadata entry " + json_string(key);
        if (has("in/" + setting) && text != file.metadata.end())
            fail("check.value", "%s is given, and so is %s; leave one out", place.c_str(),
                 where(need("in/" + setting)).c_str());
        if (has("in/" + setting)) {
            place = where(need("in/" + setting));
            x = in<double>(setting, {}).values[0];
        } else if (text != file.metadata.end()) {
            const std::optional<double> parsed = text->second == "inf" ? INFINITY : to_number(text->second);
            require(parsed.has_value(), "check.value", place, " is ", json_string(text->second.substr(0, 80)),
                    ", expected a number");
            x = *parsed;
        } else if (fallback) {
            x = *fallback;
        } else {
            fail("check.missing", "%s: case %s has neither metadata entry %s nor tensor %s, which its topic needs",
                 file.path.c_str(), json_string(name).c_str(), json_string(key).c_str(),
                 json_string(name + "/in/" + setting).c_str());
        }
        require(x >= low && x <= high, "check.value", place, " is ", number_text(x), ", expected a number from ", low,
                " to ", high);
        return x;
    }
    template <class T = int64_t>
    T whole(const std::string& setting, std::optional<double> fallback, double low, double high) {
        const double x = number(setting, fallback, low, high);
        require_value(x == std::floor(x), setting, " is ", number_text(x), ", expected a whole number");
        return static_cast<T>(x);
    }
    // A word of `choices`, which are separated by |; the first is the fallback. Metadata entry CASE.NAME.
    std::string word(const std::string& setting, const std::string& choices) {
        const std::string key = name + "." + setting;
        used.insert(key);
        const auto text = file.metadata.find(key);
        const std::vector<std::string> words = split(choices, '|');
        if (text == file.metadata.end()) return words[0];
        require(contains(words, text->second), "check.value", file.path, ": metadata entry ", json_string(key), " is ",
                json_string(text->second.substr(0, 80)), ", expected one of ", choices);
        return text->second;
    }

    // The tolerance of an output: metadata CASE.tolerance.NAME, NAME up to any slash, or CASE.tolerance, or tolerance.
    Tolerance tolerance(const std::string& output) {
        for (std::string rest = output;;) {
            const std::string key = name + ".tolerance" + (rest.empty() ? "" : "." + rest);
            used.insert(key);
            const auto text = file.metadata.find(key);
            if (text != file.metadata.end())
                return parse_tolerance(text->second, file.path + ": metadata entry " + json_string(key));
            if (rest.empty() && file.metadata.contains("tolerance"))
                return parse_tolerance(file.text("tolerance"), file.path + ": metadata entry \"tolerance\"");
            if (rest.empty()) return {};
            const size_t slash = rest.rfind('/');
            rest.resize(slash == std::string::npos ? 0 : slash);
        }
    }

    // Compares `wodtem`, what this program computed, with CASE/out/NAME of the file; of a longer list in the file, the
    // first entries. Whole numbers must be equal. `optional`: the file may leave it out. `slack`: by how much more than
    // the tolerance each entry may be off. `most`: an upper bound on the tolerance, where a wider one would hide the
    // mistake that the output is for; 0: the slack is all but `absolute`.
    template <class T>
    void expect(const std::string& output, const Shape& shape, const std::vector<T>& wodtem, bool optional = false,
                const std::vector<double>& slack = {}, double most = INFINITY) {
        if ((optional && !find("out/" + output)) || metadata_or("result", "ok") != "ok") return;
        const StoredTensor& tensor = need("out/" + output);
        check_shape(tensor, shape);
        const Tolerance allowed = tolerance(output);
        const bool exact = allowed.exact || std::is_integral_v<T>;
        std::vector<long double> stored = file.numbers<long double>(tensor);
        stored.resize(wodtem.size());
        long double scale = 0;
        for (const long double x : stored)
            if (std::isfinite(x)) scale = std::max(scale, std::fabs(x));
        const double relative = precision == Precision::float64 && !rounded ? allowed.float64 : allowed.float32;
        const long double bound =
            std::min(relative, most) * scale + std::min(allowed.absolute, most > 0 ? most : INFINITY);
        size_t failures = 0, first = 0;
        long double allowed_first = 0;
        for (size_t i = 0; i < wodtem.size(); ++i) {
            const long double ours = static_cast<long double>(wodtem[i]), theirs = stored[i];
            if (ours == theirs || (std::isnan(ours) && std::isnan(theirs))) continue;
            long double here = 0;
            if (!exact && std::isfinite(theirs)) here = bound + (slack.empty() ? 0 : slack[i]);
            // A number that is stored in float32 is itself rounded.
            if (!exact && std::isfinite(theirs) && tensor.dtype == DType::F32) here += 0x1p-24L * std::fabs(theirs);
            const long double off = std::fabs(ours - theirs);
            const double share = off <= here * 1e6L ? static_cast<double>(off / here) : INFINITY;  // NaN: infinity
            worst = std::max(worst, share);
            if (share <= 1 || failures++ > 0) continue;
            first = i;
            allowed_first = here;
        }
        if (failures > 0)
            problems.push_back(
                "out/" + output + place(tensor.shape, first) + " in " + precision_name() + ": file " +
                shown(stored[first]) + ", wodtem " + shown(static_cast<long double>(wodtem[first])) +
                (allowed_first > 0 ? ", allowed difference " + shown(allowed_first) : ", which must be equal") +
                (failures > 1 ? "; " + std::to_string(failures - 1) + " more differ" : ""));
        if (verbose) {
            print("file " + output, tensor.shape, stored);
            print(std::string("wodtem ") + precision_name(), tensor.shape, wodtem);
        }
    }

    std::string metadata_or(const char* what, const char* fallback) const {
        const auto found = file.metadata.find(name + "." + what);
        return found == file.metadata.end() ? fallback : found->second;
    }

    const char* precision_name() const { return precision == Precision::float64 ? "float64" : "float32"; }

    template <class T>
    static void print(const std::string& title, const Shape& shape, const std::vector<T>& values) {
        constexpr size_t most = 64;
        std::printf("    %-28s %s", title.c_str(), shape_text(shape).c_str());
        for (size_t i = 0; i < std::min(values.size(), most); ++i)
            std::printf(" %.*Lg", std::is_same_v<T, float> ? 9 : 17, static_cast<long double>(values[i]));
        std::printf(values.size() > most ? " ... (%zu)\n" : "\n", values.size());
    }
};

// A computation with gradients: variables are inputs, `finish` compares the outputs with the file's and, where it has
// in/upstream (the gradient of some loss with respect to the output; in/upstream/NAME where there are several outputs),
// the gradient of every variable with out/gradient/NAME.
template <class T>
struct Graph {
    struct Variable {
        std::string name;
        Array<T> array;
        std::vector<T> gradient;
        Gradient<T> place;  // the tensor's, whose data are `gradient`
    };
    struct Output {
        std::string name;
        Shape shape;
        Tensor<T> tensor;
    };
    Case& c;
    Tape<T> tape;
    std::vector<std::unique_ptr<Variable>> variables = {};

    explicit Graph(Case& a_case) : c(a_case), tape(a_case.compute) {}

    Tensor<T> variable(const std::string& name, const Shape& pattern) {
        variables.push_back(std::make_unique<Variable>(Variable{name, c.in<T>(name, pattern), {}, {}}));
        Variable& v = *variables.back();
        v.gradient.resize(v.array.values.size());
        require(v.array.back() >= 1 && v.array.values.size() < 1u << 31, "check.shape", c.where(c.need("in/" + name)),
                ": has shape ", shape_text(v.array.shape), ", expected at least one column and less than 2^31 numbers");
        const bool row = v.array.shape.size() == 1;
        v.place.data = v.gradient.data();
        return {v.array.values.data(), &v.place, row ? 1 : v.array.extent(0), v.array.back()};
    }

    void finish(const std::vector<Output>& outputs) {
        std::vector<Array<T>> upstream;
        for (const Output& output : outputs) {
            c.expect(output.name, output.shape,
                     std::vector<T>(output.tensor.value, output.tensor.value + output.tensor.size()));
            const std::string name = outputs.size() == 1 ? "upstream" : "upstream/" + output.name;
            if (c.has("in/" + name))
                upstream.push_back(c.in<T>(name, output.shape));
            else
                upstream.push_back({});
        }
        if (c.named("in/upstream").empty()) return;
        const Tensor<T> loss = tape.make(1, 1);
        for (size_t i = 0; i < outputs.size(); ++i) {
            const T* from = upstream[i].values.data();
            const size_t count = upstream[i].values.size();
            const Tensor<T> output = outputs[i].tensor;
            tape.on_backward({}, [=] {
                T* const to = gradient_of(output);
                for (size_t k = 0; k < count; ++k) to[k] += from[k];
            });
        }
        tape.backward(loss);
        for (const auto& v : variables) c.expect("gradient/" + v->name, v->array.shape, v->gradient);
    }
};

Shape shape_of(auto... extents) { return {static_cast<uint64_t>(extents)...}; }

// ---------------------------------------------------------------------------------------------------------------------
// Topics: random numbers and returns

void check_rng(Case& c) {
    if (c.has("in/counter")) {  // the generator itself
        const auto counter = c.whole_in("counter", {any, 4}, 0, 0xFFFFFFFF);
        const auto key = c.whole_in("key", {counter.shape[0], 2}, 0, 0xFFFFFFFF);
        std::vector<uint32_t> words;
        for (size_t i = 0; i < counter.shape[0]; ++i) {
            const auto word = [&](size_t j) { return static_cast<uint32_t>(counter.values[4 * i + j]); };
            const Words4 w = philox({word(0), word(1), word(2), word(3)}, static_cast<uint32_t>(key.values[2 * i]),
                                    static_cast<uint32_t>(key.values[2 * i + 1]));
            words.insert(words.end(), w.begin(), w.end());
        }
        return c.expect("words", {counter.shape[0], 4}, words);
    }
    // What is drawn from it by (seed, stream, step, site, index).
    const Random random{c.whole<uint32_t>("seed", {}, 0, 0xFFFFFFFF), c.whole<uint32_t>("stream", {}, 0, 0xFFFFFFFF)};
    if (c.has("out/dropout")) {
        const uint64_t n = c.array_size("out/dropout");
        const Dropout dropout{random, c.whole<uint64_t>("update", 0, 0, 0x1p53),
                              c.whole<uint32_t>("place", 0, 0, 0xFFFFFFFF),
                              static_cast<float>(c.number("probability", {}, 0, 0.99))};
        Tape<float> tape(c.compute);
        const DropoutMask<float> mask = dropout_mask(tape, dropout, 1, n);
        std::vector<float> factors(n);
        for (size_t i = 0; i < n; ++i) factors[i] = mask.factor(i);
        return c.expect("dropout", {n}, factors);
    }
    const auto index = c.whole_in("index", {any}, 0, 0xFFFFFFFF);
    const auto numbers = [&](const char* name, int64_t fallback, int64_t low, int64_t high) {
        if (c.has(std::string("in/") + name)) return c.whole_in(name, index.shape, low, high).values;
        return std::vector<int64_t>(index.values.size(), fallback);
    };
    constexpr int64_t most = std::numeric_limits<int64_t>::max();
    const std::vector<int64_t> step = numbers("step", 0, 0, most), site = numbers("site", 0, 0, 0xFFFFFFFF),
                               bound = numbers("bound", 1, 1, most);
    std::vector<double> uniform;
    std::vector<uint64_t> below;
    std::vector<float> normal;
    for (size_t i = 0; i < index.values.size(); ++i) {
        const uint64_t at = step[i];
        const uint32_t which = static_cast<uint32_t>(index.values[i]), where = static_cast<uint32_t>(site[i]);
        uniform.push_back(random.uniform(at, which, where));
        below.push_back(random.below(bound[i], at, which, where));
        normal.push_back(random.normal(at, which, where));
    }
    c.expect("uniform", index.shape, uniform, true);
    c.expect("below", index.shape, below, true);
    c.expect("normal", index.shape, normal, true);
}

// Packed sequences: lengths [windows], whole numbers that add up to n; left out: one sequence.
std::vector<int> lengths_of(Case& c, int n) {
    if (!c.has("in/lengths")) return n > 0 ? std::vector<int>{n} : std::vector<int>{};
    const auto lengths = c.whole_in("lengths", {any}, 1, std::max(n, 1));
    int64_t total = 0;
    for (const int64_t length : lengths.values) total += length;
    c.require_value(total == n, "in/lengths add up to ", total, ", but there are ", n, " rows");
    return {lengths.values.begin(), lengths.values.end()};
}

// Trajectories laid end to end: rewards [n], lengths [trajectories].
void check_returns(Case& c) {
    const auto rewards = c.in<float>("rewards", {any});
    const double gamma = c.number("gamma", 0.99, 0, 1), scale = c.number("reward_scale", 1, 1e-9, 1e9);
    std::vector<double> g, d;
    std::vector<float> scaled;
    size_t at = 0;
    for (const int length : lengths_of(c, rewards.extent(0))) {
        Trajectory trajectory;
        trajectory.rewards.assign(&rewards.values[at], &rewards.values[at] + length);
        trajectory.states.resize(trajectory.rewards.size());
        trajectory.actions = trajectory.states;
        relabel(trajectory, 1, 1, gamma);
        g.insert(g.end(), trajectory.returns_to_go.begin(), trajectory.returns_to_go.end());
        d.insert(d.end(), trajectory.discounted_returns.begin(), trajectory.discounted_returns.end());
        at += length;
    }
    for (const double x : g) scaled.push_back(static_cast<float>(x * scale));  // the network's input
    c.expect("g", rewards.shape, g);
    c.expect("d", rewards.shape, d);
    c.precision = Precision::float32;
    c.expect("scaled_g", rewards.shape, scaled, true);
}

// ---------------------------------------------------------------------------------------------------------------------
// Topics: the layers

template <class T>
void check_linear(Case& c) {
    Graph<T> graph(c);
    const Tensor<T> x = graph.variable("x", {any, any});
    const bool conv1d = c.word("layout", "out_in|in_out") == "in_out";
    const Tensor<T> weight = graph.variable("weight", conv1d ? shape_of(x.columns, any) : shape_of(any, x.columns));
    const int out = conv1d ? weight.columns : weight.rows;
    const Tensor<T> bias = graph.variable("bias", shape_of(out));
    const Affine<T> affine = {weight, bias, conv1d ? Layout::in_out : Layout::out_in};
    graph.finish({{"y", shape_of(x.rows, out), linear(graph.tape, x, affine)}});
}

template <class T>
void check_layernorm(Case& c) {
    Graph<T> graph(c);
    const Tensor<T> x = graph.variable("x", {any, any});
    const Tensor<T> weight = graph.variable("weight", shape_of(x.columns));
    const Tensor<T> bias = graph.variable("bias", shape_of(x.columns));
    graph.finish({{"y", shape_of(x.rows, x.columns), layer_norm(graph.tape, x, Norm<T>{weight, bias})}});
}

// Both layers are GPT-2's Conv1D: weights [in, out].
template <class T>
void check_mlp(Case& c) {
    Graph<T> graph(c);
    const Tensor<T> x = graph.variable("x", {any, any});
    const Tensor<T> w1 = graph.variable("c_fc.weight", shape_of(x.columns, any));
    const Tensor<T> b1 = graph.variable("c_fc.bias", shape_of(w1.columns));
    const Tensor<T> w2 = graph.variable("c_proj.weight", shape_of(w1.columns, any));
    const Tensor<T> b2 = graph.variable("c_proj.bias", shape_of(w2.columns));
    const Tensor<T> hidden = linear(graph.tape, x, Affine<T>{w1, b1, Layout::in_out}, Activation::relu);
    const Tensor<T> y = linear(graph.tape, hidden, Affine<T>{w2, b2, Layout::in_out});
    graph.finish({{"y", shape_of(x.rows, w2.columns), y}});
}

// ---------------------------------------------------------------------------------------------------------------------
// Topics: attention and tokens

template <class T>
void check_attention(Case& c) {
    Graph<T> graph(c);
    const Tensor<T> q = graph.variable("q", {any, any}), k = graph.variable("k", shape_of(q.rows, q.columns)),
                    v = graph.variable("v", shape_of(q.rows, q.columns));
    const int heads = c.whole<int>("heads", 1, 1, 1 << 20), n = q.rows, d = q.columns;
    const std::vector<int> lengths = lengths_of(c, n);
    const bool short_enough = std::ranges::all_of(lengths, [](int length) { return length <= 4096; });
    c.require_value(d % heads == 0 && n <= 100000 && short_enough, d, " columns, ", heads, " heads, ", n,
                    " rows: heads must divide columns, and there may be 100000 rows at most, 4096 in a sequence");
    // Keys and values as c_attn lays them: side by side.
    const Tensor<T> kv = graph.tape.make(n, 2 * d);
    const auto each = [=](auto&& f) {
        for (ptrdiff_t i = 0; i < n; ++i)
            for (ptrdiff_t j = 0; j < d; ++j) f(2 * i * d + j, i * d + j);
    };
    each([&](ptrdiff_t to, ptrdiff_t from) { kv.value[to] = k.value[from], kv.value[to + d] = v.value[from]; });
    graph.tape.on_backward(kv, [=] {
        each([=](ptrdiff_t from, ptrdiff_t to) {
            k.grad()[to] += kv.grad()[from], v.grad()[to] += kv.grad()[from + d];
        });
    });
    std::vector<Span> spans;
    std::vector<int> position(n);
    std::iota(position.begin(), position.end(), 0);
    for (const int length : lengths) {
        const int first = spans.empty() ? 0 : spans.back().first_token + spans.back().tokens;
        spans.push_back({first, length, first, length});
    }
    const Tensor<T> y = attention(graph.tape, q, kv, d, spans.data(), static_cast<int>(spans.size()), position.data(),
                                  heads, dropout_at(graph.tape, 0, 0));
    graph.finish({{"y", shape_of(n, d), y}});
}

// Names in ODT's dictionary that carry nothing the action prediction uses.
bool is_unused_parameter(const std::string& name) {
    const auto starts = [&](const char* text) { return name.starts_with(text); };
    return starts("predict_state.") || starts("predict_return.") || starts("embed_timestep.") ||
           starts("transformer.wte.") || starts("transformer.wpe.") || name.ends_with(".attn.bias") ||
           name.ends_with(".attn.masked_bias");
}

// The network whose weights are in/parameter/NAME, under ODT's names; its sizes are theirs. Setting: heads.
template <class T>
std::unique_ptr<Transformer<T>> read_model(Case& c) {
    const std::set<std::string> names = c.named("in/parameter/");
    const auto shape = [&](const std::string& name) {
        const StoredTensor& tensor = c.need("in/parameter/" + name);
        c.check_shape(tensor, {any, any});
        return tensor.shape;
    };
    TransformerConfig config{};
    config.state_dim = static_cast<int>(shape("embed_state.weight")[1]);
    config.action_dim = static_cast<int>(shape("embed_action.weight")[1]);
    config.width = static_cast<int>(shape("embed_state.weight")[0]);
    const uint64_t d = config.width;
    const auto fused = [&] { return "transformer.h." + std::to_string(config.layers) + ".attn.c_attn.weight"; };
    for (; names.contains(fused()); ++config.layers)  // before anything so large is allocated
        c.check_shape(c.need("in/parameter/" + fused()), {d, 3 * d});
    config.heads = c.whole<int>("heads", config.layers > 0 ? std::nullopt : std::optional(1.0), 1, 1 << 20);
    if (names.contains("embed_ordering.weight"))
        config.max_timesteps = static_cast<int>(shape("embed_ordering.weight")[0]);
    config.head = names.contains("predict_action.logits.weight") ? Head::categorical
                  : names.contains("predict_action.0.weight")    ? Head::deterministic
                                                                 : Head::squashed_gaussian;
    auto model = std::make_unique<Transformer<T>>(config, 0);
    for (Parameter<T>& parameter : model->parameters) {
        const Array<T> array = c.in<T>("parameter/" + parameter.name, parameter.shape);
        std::copy(array.values.begin(), array.values.end(), parameter.value.begin());
    }
    for (const std::string& name : names)
        if (is_unused_parameter(name)) c.find("in/parameter/" + name);
    return model;
}

// Start values. Settings: seed, state_dim, action_dim, layers, width, head, positions, projected_dim. ->
// parameter/NAME; projection [projected_dim, state_dim].
void check_initialisation(Case& c) {
    const auto size = [&](const char* name, std::optional<double> fallback, double most) {
        return c.whole<int>(name, fallback, fallback ? 0 : 1, most);
    };
    const uint32_t seed = c.whole<uint32_t>("seed", {}, 0, 0xFFFFFFFF);
    TransformerConfig config{};
    config.state_dim = size("state_dim", {}, 1000);
    config.action_dim = size("action_dim", {}, 1000);
    config.layers = size("layers", {}, 10);
    config.width = size("width", {}, 256);
    config.heads = 1;  // no start value depends on it
    config.max_timesteps = size("positions", 0, 1000);
    const std::string head = c.word("head", "gaussian|categorical|deterministic");
    config.head = head == "gaussian"      ? Head::squashed_gaussian
                  : head == "categorical" ? Head::categorical
                                          : Head::deterministic;
    const Transformer<float> model(config, seed);
    for (const Parameter<float>& parameter : model.parameters)
        c.expect("parameter/" + parameter.name, parameter.shape, parameter.value);
    MemoryConfig memory{};
    memory.state_dim = config.state_dim;
    memory.projected_dim = size("projected_dim", 0, 64);
    memory.action_dim = memory.K = 1;
    memory.capacity = 1;
    memory.tau = 1;
    c.expect("projection", shape_of(memory.projected_dim, config.state_dim), EpisodicMemory(memory, seed).projection,
             memory.projected_dim == 0);
}

// Windows: states [n, S], actions [n, A], returns_to_go [n], timesteps [n] and lengths [windows], packed; or [windows,
// C, S], [windows, C, A], [windows, C], [windows, C] when all have C steps. Discrete actions are tokens one-hot, and
// given as whole numbers [n]. timesteps left out: 0, 1, ... in each window.
struct Windows {
    SequenceBatch sequences;
    std::vector<float> actions;  // [n, A] or [n]
    Shape steps;                 // [n], or [windows, C]
    int action_width = 1;        // of `actions`

    Shape rows_of(uint64_t width) const {
        Shape shape = steps;
        shape.push_back(width);
        return shape;
    }
};

// Actions inside (-1, 1), where atanh is finite. Errors: check.value.
std::vector<float> squashed_actions_in(Case& c, const std::string& name, const Shape& shape) {
    return c.in_range(name, shape, -1 + 0x1p-24f, 1 - 0x1p-24f, "above -1 and below 1").values;
}

std::vector<float> actions_in(Case& c, const std::string& name, const Windows& windows,
                              const TransformerConfig& config) {
    if (config.head != Head::categorical) return c.in<float>(name, windows.rows_of(config.action_dim)).values;
    const auto moves = c.whole_in(name, windows.steps, 0, config.action_dim - 1);
    return {moves.values.begin(), moves.values.end()};
}

Windows read_windows(Case& c, const TransformerConfig& config) {
    Windows windows;
    const size_t rank = c.need("in/states").shape.size();
    Shape pattern(rank == 3 ? 3 : 2, any);
    pattern.back() = config.state_dim;
    const Array<float> states = c.in<float>("states", pattern);
    windows.steps.assign(states.shape.begin(), states.shape.end() - 1);
    SequenceBatch& batch = windows.sequences;
    batch.states = states.values;
    const int n = static_cast<int>(states.values.size() / config.state_dim);
    if (rank == 3)
        batch.lengths.assign(windows.steps[0], states.extent(1));
    else
        batch.lengths = lengths_of(c, n);
    const int longest = batch.lengths.empty() ? 0 : *std::max_element(batch.lengths.begin(), batch.lengths.end());
    c.require_value(n >= 1 && n <= 1000000 && longest <= 1000, n, " steps, ", longest,
                    " in the longest window; there must be 1 to a million, and at most 1000");
    batch.returns_to_go = c.in<float>("returns_to_go", windows.steps).values;
    if (c.has("in/timesteps")) {
        const auto timesteps = c.whole_in("timesteps", windows.steps, 0, 1 << 30);
        batch.timesteps.assign(timesteps.values.begin(), timesteps.values.end());
    } else {
        for (const int length : batch.lengths)
            for (int t = 0; t < length; ++t) batch.timesteps.push_back(t);
    }
    windows.actions = actions_in(c, "actions", windows, config);
    if (config.head == Head::categorical) {
        for (const float move : windows.actions)
            for (int i = 0; i < config.action_dim; ++i)
                batch.actions.push_back(move == static_cast<float>(i) ? 1.f : 0.f);
    } else {
        windows.action_width = config.action_dim;
        batch.actions = windows.actions;
    }
    return windows;
}

// The output of every layer of one forward pass, by name, and, after backward(), the gradient of the loss at it.
template <class T>
struct LayerOutputs {
    struct Output {
        std::string name;
        Shape shape;
        std::vector<T> value;  // a copy: backward() may reuse the tape's memory
        const Gradient<T>* gradient;
    };
    std::vector<Output> outputs;

    // Records the next forward() on this tape.
    void watch(Tape<T>& tape) {
        outputs.clear();
        tape.watch = [this](const std::string& name, const Tensor<T>& x) {
            outputs.push_back({name, shape_of(x.rows, x.columns), {x.value, x.value + x.size()}, x.gradient});
        };
    }
};

// The tokens R, s, a of each step but for the last action of a window, before embed_ln; and, where the file has them,
// the outputs of all layers. Settings: dropout, and what its masks are drawn from: seed, update, part (of the batch).
template <class T>
void check_tokens(Case& c) {
    const auto model = read_model<T>(c);
    const Windows windows = read_windows(c, model->config);
    Tape<T> tape(c.compute);
    model->config.dropout = static_cast<float>(c.number("dropout", 0, 0, 0.99));
    tape.dropout_random = {c.whole<uint32_t>("seed", 0, 0, 0xFFFFFFFF), Stream::dropout};
    tape.dropout_step = c.whole<uint64_t>("update", 0, 0, 0x1p53);
    tape.part = c.whole<size_t>("part", 0, 0, 4095);
    LayerOutputs<T> layers;
    layers.watch(tape);
    forward(tape, *model, windows.sequences, Queries::every_state);
    bool held = false;
    for (const auto& output : layers.outputs) {
        held |= c.has("out/layer/" + output.name);
        c.expect("layer/" + output.name, output.shape, output.value, true);
    }
    if (!held) c.need("out/layer/embed");
}

// ---------------------------------------------------------------------------------------------------------------------
// Topic: acting

// An environment that shows given states, one after the other, and pays given rewards, whatever is done.
struct Recording : Environment {
    const Array<float>& states;    // [T, S]
    const Array<double>& rewards;  // [T]
    size_t t = 0;

    Recording(const Array<float>& shown, const Array<double>& paid) : states(shown), rewards(paid) {}
    EnvironmentSpec spec() const override { return {states.back(), 1, 0, states.extent(0)}; }
    void reset(const Random&, uint64_t, float*) override {}
    std::unique_ptr<Environment> clone() const override { return std::make_unique<Recording>(*this); }
    Step step(const float*, float* state) override {
        const double reward = rewards.values[t];
        const size_t S = states.shape[1], next = std::min(++t, rewards.values.size() - 1);
        std::copy_n(&states.values[next * S], S, state);
        return {reward, false};
    }
};

// An episode of T steps under a policy: parameter/NAME, states [T, S], rewards [T], state_mean, state_deviation [S];
// settings heads, act, target, reward_scale, eval_context, context_length, seed, episode. -> action [T, A] or [T],
// returns_to_go [T + 1]; mean, log_std [T, A] or log_probabilities [T, moves]; noise [T, A] or uniform [T]; of the
// windows, one after the other, window/lengths [T], timesteps, returns_to_go [n], states [n, S], actions [n - T, A].
void check_acting(Case& c) {
    const auto model = read_model<float>(c);
    const TransformerConfig& config = model->config;
    const bool discrete = config.head == Head::categorical;
    const uint64_t S = config.state_dim, A = config.action_dim;
    const Array<float> states = c.in<float>("states", {any, S});
    const uint64_t T = states.shape[0];
    const Array<double> rewards = c.in<double>("rewards", {T});
    const bool samples = c.word("act", "most_likely|sample") == "sample";
    Settings settings;
    settings.reward_scale = c.number("reward_scale", 1, 1e-9, 1e9);
    settings.eval_context = c.whole("eval_context", {}, 1, 1000);
    settings.context_length = c.whole("context_length", {}, 1, 1000);
    const double target = c.number("target", {}, -1e9, 1e9);
    const uint64_t number = samples ? c.whole<uint64_t>("episode", 0, 0, 0x1p53) : 0;
    const Random random{samples ? c.whole<uint32_t>("seed", {}, 0, 0xFFFFFFFF) : 0, Stream::exploration};
    c.require_value(T >= 1 && T <= 10000, "an episode of ", T, " steps, expected 1 to 10000");
    EnvironmentSpec spec{};
    spec.state_dim = config.state_dim;
    spec.action_dim = discrete ? 1 : config.action_dim;
    spec.discrete_actions = discrete ? config.action_dim : 0;
    // The agent prepares windows and chooses actions; its own network, of which only the kind of head counts, is small.
    const bool deterministic = config.head == Head::deterministic;
    settings.method = deterministic ? "dt" : "odt";
    settings.layers = settings.heads = 1;
    settings.width = deterministic ? 8 : std::max(8, config.action_dim);
    Agent agent(settings, spec);
    agent.normaliser = {c.in<float>("state_mean", {S}).values, c.in<float>("state_deviation", {S}).values};

    Recording environment(states, rewards);
    Episode episode{};
    Episode* const running[] = {&episode};
    episode.state.assign(states.values.begin(), states.values.begin() + S);
    Tape<float> tape(c.compute);
    tape.recording = false;
    std::vector<int> lengths, timesteps;
    std::vector<float> window_returns, window_states, window_actions, policies, log_std, noise;
    std::vector<double> uniform;
    const auto append = [](auto& to, const auto* from, size_t n) { to.insert(to.end(), from, from + n); };
    for (uint32_t t = 0; t < T; ++t) {
        append_target(episode, target, settings.reward_scale);
        const SequenceBatch window = acting_batch(agent, running);
        const size_t n = window.timesteps.size();
        append(lengths, window.lengths.data(), 1);
        append(timesteps, window.timesteps.data(), n);
        append(window_returns, window.returns_to_go.data(), n);
        append(window_states, window.states.data(), n * S);
        append(window_actions, window.actions.data(), (n - 1) * A);
        tape.reset();
        const Policy<float> policy = forward(tape, *model, window, Queries::last_state);
        append(policies, policy.output.value, A);
        if (config.head == Head::squashed_gaussian) append(log_std, policy.log_std.value, A);
        for (uint32_t i = 0; i < A; ++i) noise.push_back(random.normal(number, t, i));
        uniform.push_back(random.uniform(number, t));
        const std::vector<float> action =
            choose_action(agent, policy, 0, samples ? Act::sample : Act::greedy, random, number, t);
        episode.step(environment, action.data(), spec.action_dim);
    }
    append_target(episode, target, settings.reward_scale);
    const uint64_t n = timesteps.size();
    c.expect("window/lengths", {T}, lengths, true);
    c.expect("window/timesteps", {n}, timesteps, true);
    c.expect("window/returns_to_go", {n}, window_returns, true);
    c.expect("window/states", {n, S}, window_states, true);
    c.expect("window/actions", {n - T, A}, window_actions, true);
    c.expect("returns_to_go", {T + 1}, episode.targets, true);
    c.expect(discrete ? "log_probabilities" : "mean", {T, A}, policies, true);
    if (config.head == Head::squashed_gaussian) c.expect("log_std", {T, A}, log_std, true);
    if (samples && discrete) c.expect("uniform", {T}, uniform, true);
    if (samples && config.head == Head::squashed_gaussian) c.expect("noise", {T, A}, noise, true);
    const std::vector<float>& actions = episode.trajectory.actions;
    if (discrete)
        c.expect("action", {T}, std::vector<int>(actions.begin(), actions.end()));
    else
        c.expect("action", {T, A}, actions);
}

// ---------------------------------------------------------------------------------------------------------------------
// Topics: policy heads

// mean [n, A]; log_std [n, A], or log_std_raw [n, A] before it is squashed. actions [n, A] -> log_prob [n]; noise
// [n, A] -> entropy [n], action [n, A]; data_actions [n, A] -> clamped.
template <class T>
void check_policy_gaussian(Case& c) {
    Graph<T> graph(c);
    const Tensor<T> mean = graph.variable("mean", {any, any});
    const Shape shape = shape_of(mean.rows, mean.columns), rows = shape_of(mean.rows);
    const bool raw = c.has("in/log_std_raw");
    Policy<T> policy = {Head::squashed_gaussian, mean, graph.variable(raw ? "log_std_raw" : "log_std", shape)};
    std::vector<typename Graph<T>::Output> outputs;
    if (raw) {
        policy.log_std = squash_log_std(graph.tape, policy.log_std);
        outputs.push_back({"log_std", shape, policy.log_std});
    }
    std::vector<float> actions, noise;
    if (c.has("in/actions")) {
        actions = squashed_actions_in(c, "actions", shape);
        outputs.push_back({"log_prob", rows, gaussian_log_prob(graph.tape, policy, actions.data())});
    }
    if (c.has("in/noise")) {
        noise = c.in<float>("noise", shape).values;
        outputs.push_back({"entropy", rows, gaussian_entropy(graph.tape, policy, noise.data())});
    }
    if constexpr (std::is_same_v<T, float>) {
        std::vector<float> sampled, likely, clamped;
        std::vector<double> slack;  // of a sum that cancels: a dozen roundings of exp(log_std) noise, through tanh
        for (size_t i = 0; i < mean.size(); ++i) {
            likely.push_back(clamp_action(std::tanh(policy.output.value[i])));
            if (noise.empty()) continue;
            const float spread = std::exp(policy.log_std.value[i]) * noise[i];
            const double a = sampled.emplace_back(clamp_action(std::tanh(policy.output.value[i] + spread)));
            slack.push_back(12 * 0x1p-24 * std::fabs(spread) * (1 - a * a));
        }
        constexpr double most = 4 * 0x1p-24;  // the clamp takes off 1e-6
        c.expect("most_likely", shape, likely, true, {}, most);
        if (!noise.empty()) c.expect("sampled", shape, sampled, true, slack, most);
        if (c.has("in/data_actions"))
            for (const float a : c.in<float>("data_actions", shape).values) clamped.push_back(clamp_action(a));
        if (c.has("in/data_actions")) c.expect("clamped", shape, clamped, false, {}, 0x1p-24);
    }
    if (outputs.empty() && c.has("in/data_actions")) return;
    graph.finish(outputs);
}

// logits [n, moves] -> log_probabilities, entropy [n], most_likely [n]; actions [n] -> log_prob [n]; uniform [n] ->
// sampled [n].
template <class T>
void check_policy_discrete(Case& c) {
    Graph<T> graph(c);
    const Tensor<T> logits = graph.variable("logits", {any, any});
    const Shape rows = shape_of(logits.rows);
    const Tensor<T> log_p = log_softmax(graph.tape, logits);
    std::vector<typename Graph<T>::Output> outputs = {
        {"log_probabilities", shape_of(logits.rows, logits.columns), log_p},
        {"entropy", rows, categorical_entropy(graph.tape, log_p)}};
    std::vector<float> actions;
    if (c.has("in/actions")) {
        const auto moves = c.whole_in("actions", rows, 0, logits.columns - 1);
        actions.assign(moves.values.begin(), moves.values.end());
        outputs.push_back({"log_prob", rows, categorical_log_prob(graph.tape, log_p, actions.data())});
    }
    if constexpr (std::is_same_v<T, float>) {
        std::vector<int> likely, sampled;
        const auto uniform = c.has("in/uniform") ? c.uniform_in("uniform", rows) : c.in_or<double>("uniform", rows, 0);
        for (int row = 0; row < logits.rows; ++row) {
            const float* p = log_p.value + ptrdiff_t{row} * logits.columns;
            likely.push_back(most_likely_action(p, logits.columns));
            sampled.push_back(sampled_action(p, logits.columns, uniform.values[row]));
        }
        c.expect("most_likely", rows, likely, true);
        if (c.has("in/uniform")) c.expect("sampled", rows, sampled);
    }
    graph.finish(outputs);
}

// DT's head: raw [n, A] -> action [n, A]; actions [n, A] -> log_prob [n], minus the mean squared error.
template <class T>
void check_policy_deterministic(Case& c) {
    Graph<T> graph(c);
    const Tensor<T> raw = graph.variable("raw", {any, any});
    const Shape shape = shape_of(raw.rows, raw.columns);
    const Policy<T> policy = {Head::deterministic, tanh_of(graph.tape, raw), {}};
    const auto actions = c.in<float>("actions", shape);
    graph.finish({{"action", shape, policy.output},
                  {"log_prob", shape_of(raw.rows), log_prob(graph.tape, policy, actions.values.data())}});
}

// ---------------------------------------------------------------------------------------------------------------------
// Topics: the memory

// The table after (states [n, S], actions [n, A], e [n]) in this order, by eq. (4). Settings: capacity, K, epsilon,
// tau, eviction, exclude_self; projection [F1, S].
struct Table {
    Array<float> states, actions;
    Array<double> e;
    EpisodicMemory memory;
};

MemoryConfig memory_settings(Case& c, int state_dim, int action_dim, int projected_dim, size_t n) {
    MemoryConfig config{};
    config.state_dim = state_dim;
    config.action_dim = action_dim;
    config.projected_dim = projected_dim;
    // A capacity above the number of rows changes nothing, so no more is allocated.
    config.capacity = std::min(n + 1, c.whole<size_t>("capacity", static_cast<double>(n + 1), 1, 1e12));
    config.K = c.whole<int>("K", 1, 1, 100000);
    config.epsilon = c.number("epsilon", INFINITY, 0, INFINITY);
    config.tau = c.number("tau", 1, 1e-9, 1e9);
    config.exclude_self = c.whole("exclude_self", 0, 0, 1) == 1;
    config.eviction = c.word("eviction", "lfu|lru") == "lfu" ? Eviction::lfu : Eviction::lru;
    return config;
}

Table empty_table(Case& c) {
    const Array<float> states = c.in<float>("states", {any, any});
    const uint64_t n = states.shape[0];
    const Array<float> actions =
        c.has("in/actions") ? c.in<float>("actions", {n, any}) : Array<float>{{n, 1}, std::vector<float>(n)};
    const Array<double> e = c.in_or<double>("e", {n}, 0);
    const bool projects = c.has("in/projection");
    const Array<double> projection =
        projects ? c.in<double>("projection", {any, states.shape[1]}) : Array<double>{{0, 0}, {}};
    check_column("projection", projection.values, projection.shape[0], projection.shape[1]);
    EpisodicMemory memory(memory_settings(c, states.extent(1), actions.extent(1), projection.extent(0), n), 0);
    memory.projection = projection.values;
    return {states, actions, e, std::move(memory)};
}

void take_in(Table& table, size_t row, EpisodicMemory::Changes& changes) {
    const auto state = table.states.values.begin() + row * table.memory.S,
               action = table.actions.values.begin() + row * table.memory.A;
    Trajectory step;
    step.states.assign(state, state + table.memory.S);
    step.actions.assign(action, action + table.memory.A);
    step.rewards = {0};
    step.discounted_returns = {table.e.values[row]};
    const EpisodicMemory::Changes now = table.memory.update(step);
    changes.inserted += now.inserted;
    changes.improved += now.improved;
    changes.kept += now.kept;
    changes.evicted += now.evicted;
}

Table full_table(Case& c) {
    Table table = empty_table(c);
    EpisodicMemory::Changes changes;
    for (size_t row = 0; row < table.states.shape[0]; ++row) take_in(table, row, changes);
    return table;
}

uint32_t entry_of(const Table& table, size_t row) {
    const EpisodicMemory& m = table.memory;
    return m.slots[m.find_slot(state_key(&table.states.values[row * m.S], m.S))];
}

// What becomes of the rows. looks_up [n]: rows that are look-ups instead, of the row's state; their neighbours count as
// accessed. -> stored [n]: whether the state is in the table at the end; e, actions, accesses [n]: of its entry.
void check_memory_update(Case& c) {
    Table table = empty_table(c);
    const Shape rows = {table.states.shape[0]};
    const auto looks_up = c.in_or<double>("looks_up", rows, 0);
    EpisodicMemory::Changes changes;
    for (size_t row = 0; row < rows[0]; ++row) {
        if (looks_up.values[row] == 0) {
            take_in(table, row, changes);
        } else {
            const Neighbourhoods found = table.memory.search(&table.states.values[row * table.memory.S], 1);
            table.memory.count_accesses(found[0]);
        }
    }
    std::vector<int> stored;
    std::vector<double> e;
    std::vector<float> actions;
    std::vector<uint64_t> accesses;
    for (size_t row = 0; row < rows[0]; ++row) {
        const uint32_t entry = entry_of(table, row);
        const bool there = entry != no_entry;
        stored.push_back(there);
        e.push_back(there ? table.memory.e[entry] : NAN);
        accesses.push_back(there ? table.memory.priority[entry] : 0);
        for (size_t i = 0; i < table.memory.A; ++i)
            actions.push_back(there ? table.memory.actions[entry * table.memory.A + i] : NAN);
    }
    c.expect("stored", rows, stored);
    c.expect("e", rows, e);
    c.expect("actions", table.actions.shape, actions, true);
    c.expect("accesses", rows, accesses, true);
    c.expect("size", {}, std::vector<uint64_t>{table.memory.size()}, true);
    c.expect("changes", {4}, std::vector<uint64_t>{changes.inserted, changes.improved, changes.kept, changes.evicted},
             true);
}

// query [m, S]: K(s_q) of each.
Neighbourhoods look_up(Case& c, const Table& table, uint64_t& m) {
    const auto query = c.in<float>("query", {any, table.states.shape[1]});
    m = query.shape[0];
    const int K = table.memory.config.K;
    c.require_value(m * K <= 100000000, m, " queries of ", K, " neighbours are more than 10^8");
    return table.memory.search(query.values.data(), m);
}

// -> neighbours [m, K]: rows of states, closest first, then -1; distances [m, K], then infinity; count [m]; e_hat [m]:
// NaN where K(s_q) is empty.
void check_memory_lookup(Case& c) {
    const Table table = full_table(c);
    uint64_t m = 0;
    const Neighbourhoods found = look_up(c, table, m);
    std::map<uint32_t, int> row_of;
    for (size_t row = table.states.shape[0]; row-- > 0;) row_of[entry_of(table, row)] = static_cast<int>(row);
    std::vector<int> neighbours, count;
    std::vector<float> distances;
    std::vector<double> e_hat;
    for (size_t i = 0; i < m; ++i) {
        for (size_t k = 0; k < found.K; ++k) {
            const bool there = k < found[i].size();
            neighbours.push_back(there ? row_of.at(found[i][k].entry) : -1);
            distances.push_back(there ? found[i][k].distance : INFINITY);
        }
        count.push_back(static_cast<int>(found[i].size()));
        e_hat.push_back(approximate_return(table.memory, found[i]));
    }
    c.expect("neighbours", {m, found.K}, neighbours, c.has("out/e_hat"));
    c.expect("count", {m}, count, true);
    c.expect("distances", {m, found.K}, distances, true);
    c.expect("e_hat", {m}, e_hat, true);
}

// uniform [m] -> action [m, A]: a-hat(s_q).
void check_memory_action(Case& c) {
    const Table table = full_table(c);
    uint64_t m = 0;
    const Neighbourhoods found = look_up(c, table, m);
    const auto uniform = c.uniform_in("uniform", {m});
    std::vector<float> actions;
    for (size_t i = 0; i < m; ++i) {
        const float* action = table.memory.advised_action(found[i], uniform.values[i]);
        actions.insert(actions.end(), action, action + table.memory.A);
    }
    c.expect("action", {m, table.memory.A}, actions);
}

// d [m], alpha -> w [m].
void check_weights(Case& c) {
    const Table table = full_table(c);
    uint64_t m = 0;
    const Neighbourhoods found = look_up(c, table, m);
    const auto d = c.in<double>("d", {m});
    const double alpha = c.number("alpha", {}, 0, 1);
    std::vector<double> w, e_hat;
    for (size_t i = 0; i < m; ++i) {
        w.push_back(EpisodicMemory::weight(table.memory.is_optimal(found[i], d.values[i]), alpha));
        e_hat.push_back(approximate_return(table.memory, found[i]));
    }
    c.expect("w", {m}, w);
    c.expect("e_hat", {m}, e_hat, true);
}

// ---------------------------------------------------------------------------------------------------------------------
// Topics: objective and optimiser

// Forward, objective and backward of one update, as update() makes them.
template <class T>
Objective<T> learn(Tape<T>& tape, const Transformer<T>& model, const Batch& batch, const float* noise,
                   std::type_identity_t<T> lambda, bool constrain_entropy) {
    const Policy<T> policy = forward(tape, model, batch.sequences, Queries::every_state);
    const Objective<T> result = objective(tape, policy, batch, noise, lambda, constrain_entropy);
    tape.backward(result.lagrangian);
    return result;
}

// The batch of the objective: weights [n] (default 1), remembered_actions (default: the actions), and the share of each
// step in the mean over steps, then windows.
Batch read_batch(Case& c, const Windows& windows, const TransformerConfig& config) {
    Batch batch;
    batch.sequences = windows.sequences;
    batch.actions = windows.actions;
    batch.advised_actions =
        c.has("in/remembered_actions") ? actions_in(c, "remembered_actions", windows, config) : windows.actions;
    batch.weights = c.in_or<float>("weights", windows.steps, 1).values;
    if (config.head == Head::squashed_gaussian)
        for (const char* name : {"actions", "remembered_actions"})
            if (c.has(std::string("in/") + name)) squashed_actions_in(c, name, windows.rows_of(config.action_dim));
    if (c.has("in/weights")) c.in_range("weights", windows.steps, 0.0f, 1.0f, "from 0 to 1");
    const std::vector<int>& lengths = windows.sequences.lengths;
    for (const int length : lengths)
        batch.coefficients.insert(batch.coefficients.end(), length,
                                  1.0 / (static_cast<double>(lengths.size()) * length));
    return batch;
}

// The largest error of storing x in float32.
double half_ulp(double x) {
    const float y = std::fabs(static_cast<float>(x));
    return (static_cast<double>(std::nextafter(y, INFINITY)) - static_cast<double>(y)) / 2;
}

// How far parameters after updates in float32 may be off, element by element. Its three parts are described in
// tests/vectors/README.md, "How outputs are compared".
struct Slack {
    std::vector<double> off;                    // [parameters] of the clipped gradients of all updates so far
    std::vector<double> moved;                  // [parameters] the largest step of an update, summed over updates
    std::vector<std::vector<double>> rounding;  // [parameters][size]

    // inexact: the file's values were not float32 numbers, so reading them has rounded them already.
    Slack(const std::vector<Parameter<float>>& parameters, bool inexact)
        : off(parameters.size()),
          moved(parameters.size()) {
        for (const Parameter<float>& parameter : parameters) {
            rounding.emplace_back(parameter.value.size());
            for (size_t i = 0; inexact && i < parameter.value.size(); ++i)
                rounding.back()[i] = half_ulp(parameter.value[i]);
        }
    }

    // Adds what one update does. before: the values before it; gradient_off: the possible error of each gradient before
    // `clip` scales it. Adam divides a gradient by its own size; where that is close to rounding, as in the keys' bias,
    // which softmax does not see, the step is noise divided by noise. If the entries of a gradient are off by at most
    // `off`, so are m and sqrt(v), and u = m / (sqrt(v) + epsilon) is off by (1 + |u|) off / (sqrt(v) + epsilon), and
    // by no more than 2. Through LAMB's ratio the norm of all these errors reaches every entry.
    void add(const std::vector<std::vector<float>>& before, const std::vector<double>& gradient_off, double clip,
             const Optimizer& optimizer, const OptimizerConfig& config) {
        const bool lamb = config.rule == OptimizerConfig::Rule::lamb;
        const double bias1 = 1 - power(config.beta1, optimizer.updates),
                     bias2 = 1 - power(config.beta2, optimizer.updates);
        for (size_t p = 0; p < rounding.size(); ++p) {
            off[p] = std::max(off[p], clip * gradient_off[p]);
            const size_t n = rounding[p].size();
            std::vector<double> u(n), du(n);
            double squares_of_value = 0, squares_of_u = 0, squares_of_du = 0;
            for (size_t i = 0; i < n; ++i) {
                const double divisor = std::sqrt(optimizer.second_moment[p][i] / bias2) + config.epsilon;
                u[i] = optimizer.first_moment[p][i] / bias1 / divisor;
                if (optimizer.second_moment[p][i] != 0)  // v is exactly 0 only where no gradient ever was
                    du[i] = std::min(2.0, (1 + std::fabs(u[i])) * off[p] / divisor);
                if (lamb) u[i] += config.weight_decay * before[p][i];
                squares_of_value += static_cast<double>(before[p][i]) * before[p][i];
                squares_of_u += u[i] * u[i];
                squares_of_du += du[i] * du[i];
            }
            const bool adapts =
                lamb && (config.weight_decay != 0 || config.always_adapt) && squares_of_value > 0 && squares_of_u > 0;
            const double learning_rate =
                config.learning_rate * warmup_factor(optimizer.updates - 1, config.warmup_updates);
            const double rate = learning_rate * (adapts ? std::sqrt(squares_of_value / squares_of_u) : 1);
            const double ratio = adapts ? std::sqrt(squares_of_du / squares_of_u) : 0;
            const double decay = lamb ? 0 : learning_rate * config.weight_decay, roundings = decay != 0 ? 3 : 1;
            double largest = 0;
            for (size_t i = 0; i < n; ++i) {
                const double from = before[p][i], step = decay * from + rate * u[i];
                largest = std::max(largest, std::fabs(step));
                rounding[p][i] += rate * (du[i] + ratio * std::fabs(u[i])) +
                                  roundings * half_ulp(std::max(std::fabs(from), std::fabs(from - step)));
            }
            moved[p] += largest;
        }
    }

    // The allowed error of each entry of parameter p; `relative` is the tolerance as a part of the steps.
    std::vector<double> allowed(size_t p, double relative) const {
        std::vector<double> all = rounding[p];
        for (double& x : all) x += relative * moved[p];
        return all;
    }
};

std::vector<std::vector<float>> values_of(const std::vector<Parameter<float>>& parameters) {
    std::vector<std::vector<float>> values;
    for (const Parameter<float>& parameter : parameters) values.push_back(parameter.value);
    return values;
}

// Log lambda, its optimiser, and the allowed error of log lambda after each update.
struct CheckedTemperature {
    Temperature temperature = Temperature(1);
    std::optional<Slack> slack = {};
    std::vector<float> log_lambda = {};
    std::vector<double> allowed = {};

    void start(double value) {
        temperature.log_lambda[0].value[0] = static_cast<float>(value);
        slack.emplace(temperature.log_lambda, true);
    }
    // Takes one step of lambda. H_off: the possible error of H.
    void step(Case& c, const Settings& settings, double H, double H_off) {
        const auto before = values_of(temperature.log_lambda);
        OptimizerConfig config;
        config.rule = OptimizerConfig::Rule::adamw;
        config.learning_rate = settings.lambda_learning_rate;
        config.weight_decay = 0;
        config.warmup_updates = 0;
        update_lambda(c.compute, temperature, settings, H);
        slack->add(before, {std::exp(before[0][0]) * H_off}, 1, temperature.optimizer, config);
        log_lambda.push_back(temperature.log_lambda[0].value[0]);
        allowed.push_back(slack->allowed(0, c.tolerance("log_temperature").float32)[0]);
    }
};

// mean [n, A] (logits [n, moves] for the categorical head, raw for DT's), log_std [n, A], actions, ..., noise [n, A],
// log_temperature, eta -> L, H, loss, gradients; log_temperature after one step.
template <class T>
void check_objective(Case& c) {
    Graph<T> graph(c);
    TransformerConfig config{};
    config.head = c.has("in/logits") ? Head::categorical
                  : c.has("in/raw")  ? Head::deterministic
                                     : Head::squashed_gaussian;
    const char* name = config.head == Head::categorical     ? "logits"
                       : config.head == Head::deterministic ? "raw"
                                                            : "mean";
    Policy<T> policy = {config.head, graph.variable(name, {any, any}), {}};
    config.action_dim = policy.output.columns;
    const bool gaussian = config.head == Head::squashed_gaussian;
    if (gaussian) policy.log_std = graph.variable("log_std", shape_of(policy.output.rows, config.action_dim));
    if (config.head == Head::categorical) policy.output = log_softmax(graph.tape, policy.output);
    if (config.head == Head::deterministic) policy.output = tanh_of(graph.tape, policy.output);
    Windows windows;
    windows.steps = shape_of(policy.output.rows);
    windows.sequences.lengths = lengths_of(c, policy.output.rows);
    windows.actions = actions_in(c, "actions", windows, config);
    const Batch batch = read_batch(c, windows, config);
    const bool constrain = config.head != Head::deterministic;
    std::vector<float> noise;
    if (gaussian) noise = c.in<float>("noise", windows.rows_of(config.action_dim)).values;
    const double log_lambda = constrain ? c.number("log_temperature", std::log(0.1), -50, 50) : 0;
    const T lambda = static_cast<T>(std::exp(static_cast<T>(log_lambda)));
    const Objective<T> result = objective(graph.tape, policy, batch, noise.data(), lambda, constrain);
    const auto scalar = [&](const char* output, T value, bool optional) {
        c.expect(output, {}, std::vector<T>{value}, optional);
    };
    scalar("L", result.L.value[0], false);
    scalar("loss", result.lagrangian.value[0], true);
    if (constrain) scalar("H", result.H.value[0], false);
    graph.tape.backward(result.lagrangian);
    for (const auto& v : graph.variables)
        c.expect("gradient/" + v->name, v->array.shape, v->gradient, c.named("out/gradient/").empty());
    if (!constrain || !std::is_same_v<T, float>) return;
    Settings settings;  // one step of lambda
    const bool steps = c.has("out/log_temperature");
    settings.eta = c.number("eta", steps ? std::nullopt : std::optional(0.0), -1e9, 1e9);
    settings.lambda_learning_rate = c.number("lambda_learning_rate", 1e-4, 0, 1);
    if (!steps) return;
    CheckedTemperature temperature;
    temperature.start(log_lambda);
    const double H = static_cast<double>(result.H.value[0]);
    temperature.step(c, settings, H, c.tolerance("H").float32 * std::fabs(H));
    c.expect("log_temperature", {}, temperature.log_lambda, false, temperature.allowed, 0);
}

// parameter/NAME [...], gradient/NAME [steps, ...] -> after/NAME [steps, ...]: the parameter after each step; norm
// [steps]: of all gradients before clipping. Settings: those of OptimizerConfig.
void check_optimizer(Case& c) {
    OptimizerConfig config;
    const std::string rule = c.word("optimizer", "lamb|adamw");
    config.rule = rule == "lamb" ? OptimizerConfig::Rule::lamb : OptimizerConfig::Rule::adamw;
    config.learning_rate = c.number("learning_rate", {}, 0, 1e9);
    config.beta1 = c.number("beta1", config.beta1, 0, 1);
    config.beta2 = c.number("beta2", config.beta2, 0, 1);
    config.epsilon = c.number("optimizer_epsilon", config.epsilon, 0, 1);
    config.weight_decay = c.number("weight_decay", 0, 0, 1e9);
    config.always_adapt = c.whole("always_adapt", 0, 0, 1) == 1;
    config.clip_norm = c.number("clip_norm", config.clip_norm, 0, 1e9);
    config.warmup_updates = c.whole<uint64_t>("warmup_updates", 0, 0, 1e9);
    Optimizer optimizer;
    optimizer.updates = c.whole<uint64_t>("updates_before", 0, 0, 1e9);
    std::vector<Parameter<float>> parameters;
    std::vector<Array<float>> gradients;
    std::vector<std::vector<float>> after;
    std::vector<std::vector<double>> allowed;
    uint64_t steps = any;
    for (const std::string& name : c.named("in/parameter/")) {
        Shape shape = c.need("in/parameter/" + name).shape;
        const Array<float> value = c.in<float>("parameter/" + name, shape);
        require(!value.values.empty() && !shape.empty(), "check.shape", c.where(c.need("in/parameter/" + name)),
                ": has shape ", shape_text(shape), ", expected one axis or more, and an entry");
        parameters.push_back({name, shape, value.values, std::vector<float>(value.values.size())});
        shape.insert(shape.begin(), steps);
        gradients.push_back(c.in<float>("gradient/" + name, shape));
        steps = gradients.back().shape[0];
    }
    if (parameters.empty()) c.need("in/parameter/NAME");
    after.resize(parameters.size());
    allowed.resize(parameters.size());
    std::vector<double> norms;
    Slack slack(parameters, c.rounded);
    for (size_t step = 0; step < steps; ++step) {
        const auto before = values_of(parameters);
        for (size_t p = 0; p < parameters.size(); ++p)
            std::copy_n(gradients[p].values.begin() + step * parameters[p].value.size(), parameters[p].value.size(),
                        parameters[p].gradient.begin());
        norms.push_back(update_parameters(c.compute, parameters, optimizer, config));
        slack.add(before, std::vector<double>(parameters.size()), 1, optimizer, config);
        for (size_t p = 0; p < parameters.size(); ++p) {
            const auto here = slack.allowed(p, c.tolerance("after/" + parameters[p].name).float32);
            allowed[p].insert(allowed[p].end(), here.begin(), here.end());
            after[p].insert(after[p].end(), parameters[p].value.begin(), parameters[p].value.end());
        }
    }
    for (size_t p = 0; p < parameters.size(); ++p)
        c.expect("after/" + parameters[p].name, gradients[p].shape, after[p], false, allowed[p], 0);
    c.expect("norm", {steps}, norms, true);
}

// ---------------------------------------------------------------------------------------------------------------------
// Topics: the replay buffer, scores and the grid world

// lengths [trajectories], rewards [n]. The first `initial` (all) trajectories are the data set, the others come one by
// one. draws [m]: a step of the buffer, all trajectories laid end to end. -> order: which trajectory each place of the
// buffer holds; trajectory (a place), start, length [m].
void check_sampling(Case& c) {
    const auto rewards = c.in<float>("rewards", {any});
    const std::vector<int> lengths = lengths_of(c, rewards.extent(0));
    const size_t count = lengths.size();
    const size_t initial = c.whole<size_t>("initial", static_cast<double>(count), 0, static_cast<double>(count));
    const int context_length = c.whole<int>("context_length", 20, 1, 1 << 30);
    ReplayBuffer buffer{
        1, 1, 1.0, c.whole<size_t>("capacity", static_cast<double>(std::max<size_t>(count, 1)), 1, 1e9), {}, 0, {}};
    std::vector<Trajectory> trajectories;
    size_t at = 0;
    for (size_t i = 0; i < count; ++i) {
        Trajectory trajectory;
        const auto first = rewards.values.begin() + at;
        trajectory.rewards.assign(first, first + lengths[i]);
        trajectory.states.assign(trajectory.rewards.size(), static_cast<float>(i));
        trajectory.actions = trajectory.states;
        relabel(trajectory, 1, 1, 1.0);
        trajectories.push_back(trajectory);
        at += trajectory.rewards.size();
    }
    const auto middle = trajectories.begin() + initial;
    buffer.start(offline_set({trajectories.begin(), middle}, c.whole("keep_lowest", 1, 0, 1) == 1));
    for (auto next = middle; next != trajectories.end(); ++next) buffer.add(*next);
    std::vector<int> order;
    for (const Trajectory& trajectory : buffer.trajectories) order.push_back(static_cast<int>(trajectory.states[0]));
    c.expect("order", {order.size()}, order);
    if (!c.has("in/draws")) return;
    const bool uniform = c.word("sampling", "by_length|uniform") == "uniform";
    const auto draws = c.whole_in("draws", uniform ? Shape{any, 2} : Shape{any}, 0,
                                  buffer.ends.empty() ? -1 : static_cast<int64_t>(buffer.ends.back()) - 1);
    const Shape windows = {draws.shape[0]};
    std::vector<int> trajectory, start, length;
    for (size_t i = 0; i < windows[0]; ++i) {
        c.require_value(!uniform || (draws.values[2 * i] < std::ssize(order) &&
                                     draws.values[2 * i + 1] < buffer.trajectories[draws.values[2 * i]].length()),
                        "draw ", i, " names no step of the buffer");
        uint64_t step = draws.values[uniform ? 2 * i + 1 : i];
        if (uniform && draws.values[2 * i] > 0) step += buffer.ends[draws.values[2 * i] - 1];
        const Window window = buffer.window_at(step, context_length);
        trajectory.push_back(static_cast<int>(window.trajectory));
        start.push_back(window.start);
        length.push_back(window.length);
    }
    c.expect("trajectory", windows, trajectory);
    c.expect("start", windows, start);
    c.expect("length", windows, length);
}

// Two kinds: states [n, S] -> mean, deviation [S], normalised [n, S]; returns [m] and metadata CASE.task -> score [m].
void check_normalize(Case& c) {
    if (c.has("in/returns")) {
        const auto returns = c.in<double>("returns", {any});
        std::string tasks;
        for (const MujocoTask& task : mujoco_tasks) tasks += (tasks.empty() ? "" : "|") + std::string(task.name);
        const MujocoTask& task = *find_mujoco_task(c.word("task", tasks));
        std::vector<double> score;
        for (const double x : returns.values) score.push_back(normalised_score(task, x));
        c.precision = Precision::float64;
        return c.expect("score", returns.shape, score);
    }
    const auto states = c.in<float>("states", {any, any});
    require(!states.values.empty(), "check.shape", c.where(c.need("in/states")), ": has no entry");
    Trajectory trajectory;
    trajectory.states = states.values;
    const Normaliser normaliser = fit_normaliser({trajectory}, states.extent(1));
    std::vector<float> normalised(states.values.size());
    for (size_t i = 0; i < normalised.size(); i += states.shape[1])
        normalise(&normalised[i], normaliser, &states.values[i]);
    c.expect("mean", {states.shape[1]}, normaliser.mean);
    c.expect("deviation", {states.shape[1]}, normaliser.deviation);
    c.expect("normalised", states.shape, normalised, true);
}

// cell, move [m] -> next_cell; and by step(): state [m, S], reward, terminated [m]. Without them: the behaviour
// policy's exact statistics, mean_length, sd_length, mean_return, sd_return.
void check_gridworld(Case& c) {
    const auto edge = static_cast<EdgeRule>(index_of(edge_rule_names, c.word("edge", "clipped|stays|wraps|excluded")));
    if (!c.has("in/cell")) {
        const auto behaviour =
            static_cast<Behaviour>(index_of(behaviour_names, c.word("behaviour", "right_down|left_down")));
        const ChainStatistics s = chain_statistics(behaviour, edge);
        c.precision = Precision::float64;
        c.expect("mean_length", {}, std::vector<double>{s.mean_length});
        c.expect("mean_return", {}, std::vector<double>{s.mean_return});
        c.expect("sd_length", {}, std::vector<double>{s.sd_length}, true);
        c.expect("sd_return", {}, std::vector<double>{s.sd_return}, true);
        return;
    }
    const auto cell = c.whole_in("cell", {any}, 0, grid_cells - 1);
    const auto move = c.whole_in("move", cell.shape, 0, grid_moves - 1);
    const bool steps = c.has("out/reward") || c.has("out/terminated") || c.has("out/state");
    GridWorld world;
    world.edge = edge;
    world.encoding =
        static_cast<StateEncoding>(index_of(state_encoding_names, c.word("encoding", "coordinates|one_hot")));
    std::vector<int> next, terminated;
    std::vector<double> reward;
    std::vector<float> state;
    for (size_t i = 0; i < cell.values.size(); ++i) {
        next.push_back(next_cell(edge, static_cast<int>(cell.values[i]), static_cast<int>(move.values[i])));
        if (!steps) continue;
        const float action = static_cast<float>(move.values[i]);
        std::vector<float> observed(world.spec().state_dim);
        world.cell = static_cast<int>(cell.values[i]);
        const Step step = world.step(&action, observed.data());
        reward.push_back(step.reward);
        terminated.push_back(step.terminated);
        state.insert(state.end(), observed.begin(), observed.end());
    }
    c.expect("next_cell", cell.shape, next);
    if (!steps) return;
    c.expect("reward", cell.shape, reward, true);
    c.expect("terminated", cell.shape, terminated, true);
    c.expect("state", shape_of(cell.shape[0], world.spec().state_dim), state, true);
}

// ---------------------------------------------------------------------------------------------------------------------
// Topic: whole updates

// How many updates a case wants: the largest N of after_N and the entries of the lists, or `updates`.
int wanted_updates(Case& c) {
    int most = 1;
    for (const std::string& name : c.named("out/")) {
        const size_t slash = name.find('/');
        int number = 0;
        const char* begin = name.data() + 6;
        if (name.starts_with("after_") && slash != std::string::npos &&
            std::from_chars(begin, name.data() + slash, number).ptr == name.data() + slash)
            most = std::max(most, number);
        for (const char* list : {"L", "H", "loss", "gradient_norm", "log_temperature"})
            if (name == list)
                for (const uint64_t extent : c.need("out/" + name).shape)
                    most = std::max(most, static_cast<int>(std::min<uint64_t>(extent, 1 << 20)));
    }
    constexpr int limit = 1000;
    c.require_value(most <= limit, "asks for ", most, " updates, ", limit,
                    " are the most: rounding grows from update to update");
    return c.whole<int>("updates", most, most, limit);
}

// Moments of an optimiser that has made updates before: first_moment/NAME, second_moment/NAME; left out: zeros.
void read_moments(Case& c, const auto& parameters, Optimizer& optimizer) {
    for (const auto& parameter : parameters)
        for (auto [kind, moments] : std::initializer_list<std::pair<const char*, std::vector<std::vector<float>>&>>{
                 {"first_moment/", optimizer.first_moment}, {"second_moment/", optimizer.second_moment}})
            moments.push_back(c.in_or<float>(kind + parameter.name, parameter.shape, 0).values);
}

// What `wodtem check --dump` adds of the memory: of each step its neighbours, closest first: memory/count [n],
// memory/distance [n, K], memory/e [n, K], memory/actions [n, K, A], memory/d [n], memory/uniform [n] -> memory/e_hat,
// memory/w [n], memory/a_hat [n, A], NaN where d is optimal and none is drawn. Settings: alpha, tau.
void check_advice(Case& c) {
    if (c.named("in/memory/").empty()) return;
    const auto distance = c.in<float>("memory/distance", {any, any});
    const uint64_t n = distance.shape[0], K = distance.shape[1];
    const auto count = c.whole_in("memory/count", {n}, 0, static_cast<int64_t>(K));
    const auto e = c.in<double>("memory/e", {n, K}), d = c.in<double>("memory/d", {n}),
               uniform = c.uniform_in("memory/uniform", {n});
    const auto actions = c.in<float>("memory/actions", {n, K, any});
    const double alpha = c.number("alpha", {}, 0, 1);
    MemoryConfig config{};
    config.state_dim = config.K = 1;
    config.capacity = 1;
    config.action_dim = actions.back();
    config.tau = c.number("tau", 1, 1e-9, 1e9);
    EpisodicMemory memory(config, 0);
    memory.e = e.values;
    memory.actions = actions.values;
    std::vector<double> e_hat, w;
    std::vector<float> a_hat;
    for (size_t i = 0; i < n; ++i) {
        std::vector<Neighbour> found;
        for (size_t k = i * K; k < i * K + count.values[i]; ++k)
            found.push_back({distance.values[k], static_cast<uint32_t>(k)});
        e_hat.push_back(approximate_return(memory, found));
        w.push_back(EpisodicMemory::weight(memory.is_optimal(found, d.values[i]), alpha));
        const bool drawn = !memory.is_optimal(found, d.values[i]);
        const float* action = drawn ? memory.advised_action(found, uniform.values[i]) : nullptr;
        for (size_t j = 0; j < memory.A; ++j) a_hat.push_back(drawn ? action[j] : NAN);
    }
    c.expect("memory/e_hat", {n}, e_hat);
    c.expect("memory/w", {n}, w);
    c.expect("memory/a_hat", {n, memory.A}, a_hat);
}

// How far float32 may put each gradient off: a part of the tensor's largest entry.
std::vector<double> gradient_off(const std::vector<Parameter<float>>& parameters, double relative) {
    std::vector<double> off;
    for (const Parameter<float>& parameter : parameters) {
        double largest = 0;
        for (const float g : parameter.gradient) largest = std::max(largest, std::fabs(double{g}));
        off.push_back(relative * largest);
    }
    return off;
}

// parameter/NAME and the batch of read_windows() and read_batch(), noise [n, A] or [updates, n, A]: the same batch,
// again and again. -> of the first update layer/NAME, layer_gradient/NAME, gradient/NAME; of every update L, H, loss,
// gradient_norm and, after it, log_temperature; after_N/NAME: the parameters after N updates.
template <class T>
void check_step(Case& c) {
    const auto model = read_model<T>(c);
    const TransformerConfig& config = model->config;
    const Windows windows = read_windows(c, config);
    const Batch batch = read_batch(c, windows, config);
    const bool constrain = config.head != Head::deterministic;
    Settings settings;
    settings.optimizer = c.word("optimizer", "lamb|adamw");
    settings.learning_rate = c.number("learning_rate", 1e-4, 0, 1e9);
    settings.weight_decay = c.number("weight_decay", 5e-4, 0, 1e9);
    settings.lamb_always_adapt = c.whole("always_adapt", 0, 0, 1) == 1;
    settings.clip_norm = c.number("clip_norm", 0.25, 0, 1e9);
    settings.warmup_updates = c.whole("warmup_updates", 10000, 0, 1e9);
    settings.lambda_learning_rate = c.number("lambda_learning_rate", 1e-4, 0, 1e9);
    settings.eta = c.number("eta", config.head == Head::categorical ? -1.0 : -config.action_dim, -1e9, 1e9);
    const double log_lambda = c.number("log_temperature", std::log(0.1), -50, 50);
    const int wanted = wanted_updates(c), updates = std::is_same_v<T, float> ? wanted : 1;
    std::vector<float> noise;
    size_t noise_stride = 0;
    if (config.head == Head::squashed_gaussian) {
        Shape shape = windows.rows_of(config.action_dim);
        if (c.need("in/noise").shape.size() > shape.size()) {
            noise_stride = batch.actions.size();
            shape.insert(shape.begin(), wanted);
        }
        noise = c.in<float>("noise", shape).values;
    }
    Optimizer optimizer;
    optimizer.updates = c.whole<uint64_t>("updates_before", 0, 0, 1e15);
    read_moments(c, model->parameters, optimizer);
    CheckedTemperature lambda;
    lambda.start(log_lambda);
    lambda.temperature.optimizer.updates = optimizer.updates;
    read_moments(c, lambda.temperature.log_lambda, lambda.temperature.optimizer);
    check_advice(c);
    Tape<T> tape(c.compute);
    std::optional<Slack> slack;
    if constexpr (std::is_same_v<T, float>) slack.emplace(model->parameters, c.rounded);
    std::map<std::string, std::vector<double>> lists;  // of every update
    for (int update = 1; update <= updates; ++update) {
        tape.reset();
        LayerOutputs<T> layers;
        if (update == 1) layers.watch(tape);
        const double temperature =
            std::is_same_v<T, float> ? static_cast<double>(lambda.temperature.lambda()) : std::exp(log_lambda);
        const float* update_noise = noise.data() + (update - 1) * noise_stride;
        const Objective<T> result = learn(tape, *model, batch, update_noise, static_cast<T>(temperature), constrain);
        tape.watch = nullptr;
        lists["L"].push_back(static_cast<double>(result.L.value[0]));
        lists["loss"].push_back(static_cast<double>(result.lagrangian.value[0]));
        if (constrain) lists["H"].push_back(static_cast<double>(result.H.value[0]));
        for (const auto& output : layers.outputs) {
            c.expect("layer/" + output.name, output.shape, output.value, true);
            c.expect("layer_gradient/" + output.name, output.shape,
                     std::vector<T>(output.gradient->data, output.gradient->data + output.value.size()), true);
        }
        if (update == 1)
            for (const Parameter<T>& parameter : model->parameters)
                c.expect("gradient/" + parameter.name, parameter.shape, parameter.gradient,
                         c.named("out/gradient/").empty());
        if constexpr (std::is_same_v<T, float>) {
            const auto off = gradient_off(model->parameters, c.tolerance("gradient").float32);
            const auto before = values_of(model->parameters);
            const OptimizerConfig optimizer_settings = optimizer_config(settings);
            const double norm = update_parameters(c.compute, model->parameters, optimizer, optimizer_settings);
            const double clip = settings.clip_norm > 0 ? std::min(1.0, settings.clip_norm / (norm + 1e-6)) : 1.0;
            slack->add(before, off, clip, optimizer, optimizer_settings);
            lists["gradient_norm"].push_back(norm);
            const double H = constrain ? lists["H"].back() : 0;
            if (constrain) lambda.step(c, settings, H, c.tolerance("H").float32 * std::fabs(H));
            const std::string after = "after_" + std::to_string(update) + "/";
            for (size_t p = 0; !c.named("out/" + after).empty() && p < model->parameters.size(); ++p) {
                const std::string name = after + model->parameters[p].name;
                c.expect(name, model->parameters[p].shape, model->parameters[p].value, false,
                         slack->allowed(p, c.tolerance(name).float32), 0);
            }
        }
    }
    const auto expect = [&](const std::string& name, const auto& list, const std::vector<double>& more, double most) {
        const bool one = c.has("out/" + name) && c.need("out/" + name).shape.empty();
        const Shape shape = one ? Shape{} : shape_of(wanted);
        c.expect(name, shape, one ? std::decay_t<decltype(list)>{list[0]} : list, name != "loss", more, most);
    };
    for (const auto& [name, list] : lists) expect(name, list, {}, INFINITY);
    if (std::is_same_v<T, float> && constrain) expect("log_temperature", lambda.log_lambda, lambda.allowed, 0);
    for (const std::string& name : c.named("out/"))
        if (is_unused_parameter(name.substr(name.find('/') + 1))) c.find("out/" + name);
}

// ---------------------------------------------------------------------------------------------------------------------
// Topic: whole runs

// Preset small's settings of the grid world, changed by the entries CASE.NAME. Errors: usage.setting; check.value for a
// run that takes long, because rounding grows from update to update, and vectors come from anywhere.
Settings run_settings(Case& c) {
    Settings settings = default_settings("gridworld", c.word("method", "wodtem|odt|dt"), "small");
    std::vector<std::string> assignments;
    for (const SettingRow& row : setting_rows) {
        const std::string value = c.metadata_or(row.name, "");
        if (value.empty() || contains(not_for_set, row.name)) continue;
        c.used.insert(c.name + "." + row.name);
        assignments.push_back(std::string(row.name) + "=" + value);
    }
    apply_assignments(settings, assignments);
    settings.seed = c.whole("seed", 0, 0, 0xFFFFFFFF);
    check_together(settings);
    // At most so many updates and tokens: online episodes are as short as can be, evaluated ones as long as can be.
    const double shortest = settings.edge == "wraps" ? 1 : 5;
    const double episodes = std::ceil(static_cast<double>(settings.online_steps) / shortest);
    const double updates =
        static_cast<double>(settings.offline_updates) + episodes * static_cast<double>(settings.updates_per_iteration);
    const double evaluations = 1 + episodes / static_cast<double>(settings.eval_every);
    const double steps = updates * static_cast<double>(settings.batch_size * settings.context_length) +
                         (shortest * episodes + 100 * evaluations * static_cast<double>(settings.eval_episodes)) *
                             static_cast<double>(std::min(settings.eval_context, settings.context_length));
    const double width = static_cast<double>(settings.width),
                 longest = static_cast<double>(3 * settings.context_length);
    const double products = 3 * steps * static_cast<double>(settings.layers) * width * (12 * width + 2 * longest);
    c.require_value(updates <= 1000 && products <= 2e9, "makes up to ", updates, " updates and ", products,
                    " multiplications, expected at most 1000 and 2e9");
    c.require_value(settings.data_trajectories <= 1000 && settings.table_size <= 1000, "has ",
                    settings.data_trajectories, " trajectories and ", settings.table_size,
                    " entries, expected at most 1000 of each");
    return settings;
}

// Compares the columns of a log that the file has: numbers, NaN where there is none; actions [interactions], the moves.
void expect_columns(Case& c, const std::string& log, const std::string& text) {
    const results::Log lines(log, text);
    for (const std::string& name : lines.table.header) {
        std::vector<double> column;
        for (const std::string& field : lines.texts(name.c_str()))
            if (name == "actions")
                for (const char move : field) column.push_back(move - '0');
            else
                column.push_back(to_number(field).value_or(NAN));
        c.expect(log + "/" + name, shape_of(column.size()), column, true);
    }
}

// A run from its data set to its last evaluation. -> progress/NAME [evaluations], episodes/NAME [episodes]: columns of
// progress.csv and episodes.csv, as they would be written.
void check_run(Case& c) {
    const Settings settings = run_settings(c);
    std::string progress = progress_header, episodes = episodes_header;
    Observer observer;
    observer.evaluated = [&](const ProgressRow& row, const Evaluation&) { progress += progress_line(row, settings); };
    observer.played = [&](const EpisodeRow& row) { episodes += episode_line(row, settings); };
    observer.pause = [](double) {};
    Run run(c.compute, settings, *make_environment(settings));
    begin_run(run, make_data_set(settings));
    offline_phase(run, observer);
    if (settings.online_steps > 0) online_phase(run, observer);
    expect_columns(c, "progress", progress);
    expect_columns(c, "episodes", episodes);
}

// ---------------------------------------------------------------------------------------------------------------------
// Topics: the MuJoCo tasks

// qpos [m, nq], qvel [m, nv], actions [m, A] or [m, T, A]: T steps from each state, after a reset; goal [2], physics.
// -> qpos, qvel, observation, reward, terminated after each step, [m, ...] or [m, T, ...].
void check_environment(Case& c) {
    const std::string name = c.file.text("topic").substr(4);
    const MujocoTask* task = find_mujoco_task(name);
    require(task && name == task->name, "check.topic", c.file.path, ": unknown task \"", name,
            "\"; wodtem tasks lists them");
#ifdef WODTEM_MUJOCO
    MujocoEnvironment environment(*task, static_cast<Physics>(index_of(physics_names, c.word("physics", "d4rl|2.2"))));
    const uint64_t nq = environment.model->nq, nv = environment.model->nv;
    const uint64_t A = task->action_dim, S = task->state_dim;
    const auto qpos = c.in<double>("qpos", {any, nq}), qvel = c.in<double>("qvel", {qpos.shape[0], nv});
    const bool several = c.need("in/actions").shape.size() == 3;
    const auto actions = c.in<double>("actions", several ? Shape{qpos.shape[0], any, A} : Shape{qpos.shape[0], A});
    if (c.has("in/goal")) {
        const auto goal = c.in<double>("goal", {2});
        environment.goal = {goal.values[0], goal.values[1]};
    }
    std::vector<double> after_qpos, after_qvel, observation, reward;
    std::vector<int> terminated;
    const auto append = [](std::vector<double>& to, const double* from, uint64_t n) {
        to.insert(to.end(), from, from + n);
    };
    const size_t T = several ? actions.shape[1] : 1;
    for (size_t i = 0; i < qpos.shape[0]; ++i) {
        environment.start({&qpos.values[i * nq], nq}, {&qvel.values[i * nv], nv});
        for (size_t t = 0; t < T; ++t) {
            const Step step = environment.advance({&actions.values[(i * T + t) * A], A});
            append(after_qpos, environment.data->qpos, nq);
            append(after_qvel, environment.data->qvel, nv);
            append(observation, environment.observation.data(), S);
            reward.push_back(step.reward);
            terminated.push_back(step.terminated);
        }
    }
    Shape steps(actions.shape.begin(), actions.shape.end() - 1);
    const auto rows = [&](uint64_t width) {
        Shape shape = steps;
        shape.push_back(width);
        return shape;
    };
    c.expect("qpos", rows(nq), after_qpos, true);
    c.expect("qvel", rows(nv), after_qvel, true);
    c.expect("observation", rows(S), observation);
    c.expect("reward", steps, reward);
    c.expect("terminated", steps, terminated);
#else
    fail("mujoco.absent", "%s needs MuJoCo 2.2, which was not there when this program was built; %s",
         c.file.path.c_str(), mujoco_advice);
#endif
}

// ---------------------------------------------------------------------------------------------------------------------
// Files

struct Topic {
    const char* name;  // env_: any task
    void (*in_double)(Case&);
    void (*in_float)(Case&);  // null: the code has one precision, and the other bound holds
};
constexpr Topic topics[] = {
    {"rng", nullptr, check_rng},
    {"initialisation", nullptr, check_initialisation},
    {"returns", check_returns, nullptr},
    {"linear", check_linear<double>, check_linear<float>},
    {"layernorm", check_layernorm<double>, check_layernorm<float>},
    {"mlp", check_mlp<double>, check_mlp<float>},
    {"attention", check_attention<double>, check_attention<float>},
    {"tokens", check_tokens<double>, check_tokens<float>},
    {"acting", nullptr, check_acting},
    {"policy_gaussian", check_policy_gaussian<double>, check_policy_gaussian<float>},
    {"policy_discrete", check_policy_discrete<double>, check_policy_discrete<float>},
    {"policy_deterministic", check_policy_deterministic<double>, check_policy_deterministic<float>},
    {"memory_update", check_memory_update, nullptr},
    {"memory_lookup", nullptr, check_memory_lookup},
    {"memory_action", nullptr, check_memory_action},
    {"weights", nullptr, check_weights},
    {"objective", check_objective<double>, check_objective<float>},
    {"optimizer", nullptr, check_optimizer},
    {"sampling", check_sampling, nullptr},
    {"normalize", nullptr, check_normalize},
    {"gridworld", check_gridworld, nullptr},
    {"step", check_step<double>, check_step<float>},
    {"run", nullptr, check_run},
    {"env_", check_environment, nullptr},
};

// The names of a file's cases, in its order. Errors: check.name, check.case, check.count.
std::vector<std::string> cases_of(const TensorFile& file) {
    std::vector<std::string> cases;
    std::set<std::string> known;
    for (const StoredTensor& tensor : file.tensors) {
        const size_t slash = tensor.name.find('/');
        const std::string name = tensor.name.substr(0, slash);
        const std::string rest = slash == std::string::npos ? "" : tensor.name.substr(slash + 1);
        const bool part = rest.starts_with("in/") || rest.starts_with("out/");
        require(part && !name.empty() && name.find('.') == std::string::npos, "check.name", file.path, ": tensor ",
                json_string(tensor.name), " at byte ", file.data_start + tensor.begin,
                " belongs to no case; names are CASE/in/NAME and CASE/out/NAME");
        if (known.insert(name).second) cases.push_back(name);
    }
    for (const auto& [key, text] : file.metadata) {
        const size_t dot = key.find('.');
        require(dot == std::string::npos || known.contains(key.substr(0, dot)), "check.case", file.path,
                ": metadata entry ", json_string(key), " names a case of which the file has no tensor");
    }
    const std::string& count = file.text("cases");
    require(count == std::to_string(cases.size()), "check.count", file.path, ": metadata entry \"cases\" says ",
            json_string(count.substr(0, 80)), ", the file has ", cases.size());
    require(!cases.empty(), "check.count", file.path, ": has no case");
    return cases;
}

// Text of a file without control characters, which could drive the terminal.
std::string printable(std::string text) {
    std::ranges::replace_if(text, is_control, '?');
    return text;
}

std::string entry(const Case& c, const char* what) { return printable(c.metadata_or(what, "")); }

// CASE.result: ok, or the id of the error that the case's inputs must raise.
std::string expected_error(const Case& c) {
    const std::string result = entry(c, "result");
    return result == "ok" ? "" : result;
}

// Names the first input of a case that is not finite, as "tensor ... at byte ...: entry [0, 1] is nan"; else empty.
std::string first_not_finite(const Case& c) {
    std::string text;
    for (const std::string& name : c.named("in/")) {
        if (name == "memory/distance") continue;  // infinite where there is no neighbour
        const StoredTensor& tensor = c.file.find(c.name + "/in/" + name);
        const std::vector<long double> values = c.file.numbers<long double>(tensor);
        const auto bad = std::find_if_not(values.begin(), values.end(), [](long double x) { return std::isfinite(x); });
        if (!text.empty() || bad == values.end()) continue;
        text = c.where(tensor) + ": entry " + place(tensor.shape, bad - values.begin()) + " is " + shown(*bad);
    }
    return text;
}

void print_inputs(const Case& c) {
    std::printf("  case %s\n", c.name.c_str());
    for (const char* what : {"note", "source", "tolerance"})
        if (const std::string text = entry(c, what); !text.empty()) std::printf("    %s: %s\n", what, text.c_str());
    for (const auto& [key, text] : c.file.metadata)
        if (key.starts_with(c.name + ".") && !key.ends_with(".note") && !key.ends_with(".source") &&
            !key.ends_with(".tolerance"))
            std::printf("    %s = %s\n", printable(key.substr(c.name.size() + 1)).c_str(), printable(text).c_str());
    for (const StoredTensor& tensor : c.file.tensors)
        if (tensor.name.starts_with(c.name + "/in/"))
            Case::print(tensor.name.substr(c.name.size() + 1), tensor.shape, c.file.numbers<long double>(tensor));
}

// Computes a case with each function of its topic. Errors: check.unknown for what none of them reads.
void check_case(Case& c, const Topic& topic) {
    if (c.verbose) print_inputs(c);
    for (const char* what : {"note", "source", "result"}) c.used.insert(c.name + "." + what);
    c.tolerance("");
    const std::set<std::string> outputs = c.named("out/");
    require(!outputs.empty() || !expected_error(c).empty(), "check.missing", c.file.path, ": case ",
            json_string(c.name), " has no CASE/out/NAME: nothing is expected of it");
    if (!outputs.empty() && !expected_error(c).empty())
        fail("check.unknown", "%s: is not looked at, for CASE.result says that an error is expected; leave one out",
             c.where(c.need("out/" + *outputs.begin())).c_str());
    if (topic.in_float) {  // first, because reading inputs as float shows whether they are float32 numbers
        c.precision = Precision::float32;
        topic.in_float(c);
    }
    if (topic.in_double && !(topic.in_float && c.rounded)) {
        c.precision = Precision::float64;
        topic.in_double(c);
    }
    for (const std::string& name : c.named(""))
        if (!c.used.contains(c.name + "/" + name))
            fail("check.unknown", "%s: is unknown to topic %s; tests/vectors/README.md lists its tensors",
                 c.where(c.need(name)).c_str(), topic.name);
    const auto& metadata = c.file.metadata;
    for (auto i = metadata.lower_bound(c.name + "."); i != metadata.end() && i->first.starts_with(c.name + "."); ++i) {
        const std::string& key = i->first;
        if (c.used.contains(key)) continue;
        const std::string start = c.name + ".tolerance.";
        const bool of_output = key.starts_with(start) && !c.named("out/" + key.substr(start.size())).empty();
        require(of_output, "check.unknown", c.file.path, ": metadata entry ", json_string(key), " is unknown to topic ",
                topic.name, "; tests/vectors/README.md lists its settings");
    }
}

// Checks every case of a file, prints a line for the file and a few for each failing case; returns whether all hold.
// Errors: a file that is not one of vectors; after all cases have been computed, the first malformed case.
bool check_file(const std::string& path, Compute& compute, bool verbose) {
    const TensorFile file = read_safetensors(path);
    const std::string& name = file.text("topic");
    const Topic* topic = nullptr;
    for (const Topic& t : topics)
        if (name == t.name || (std::string_view(t.name) == "env_" && name.starts_with("env_"))) topic = &t;
    require(topic, "check.topic", path, ": unknown topic ", json_string(name.substr(0, 80)),
            "; known are those of tests/vectors/README.md");
    double worst = 0;
    std::vector<Case> failed;
    std::optional<Error> malformed;  // the first; more are printed like what does not hold
    bool rounded = false;
    size_t bad = 0;  // malformed, and nothing else is wrong
    const std::vector<std::string> cases = cases_of(file);
    if (verbose) std::printf("%s: topic %s\n", path.c_str(), printable(name).c_str());
    for (const std::string& case_name : cases) {
        Case c{file, case_name, compute, verbose};
        const std::string expected = expected_error(c);
        try {
            check_case(c, *topic);
            if (!expected.empty()) c.problems.push_back("file: the error " + expected + "; wodtem: no error");
        } catch (const Error& error) {
            if (error.id == expected) continue;
            std::string text = error.what();
            if (error.id.ends_with("not_finite"))
                if (const std::string input = first_not_finite(c); !input.empty()) text = input + ": " + text;
            if (!expected.empty()) text = "file: the error " + expected + "; wodtem: " + error.id + ": " + text;
            if (!text.starts_with(path)) text = path + ": case " + json_string(case_name) + ": " + text;
            if (malformed) c.problems.push_back(text);
            if (!malformed) malformed.emplace(error.id, text);
            bad += c.problems.empty();
        }
        worst = std::max(worst, c.worst);
        rounded |= c.rounded;
        if (!c.problems.empty()) failed.push_back(c);
    }
    std::printf("%-44s %3zu cases, %zu failed, worst error %.2g of what is allowed%s\n", path.c_str(), cases.size(),
                failed.size() + bad, worst, rounded ? " (inputs rounded to float32)" : "");
    if (!failed.empty())
        std::printf("  file: the number in the file; wodtem: what this program computes. Begin with the first case.\n");
    for (const Case& c : std::span(failed).first(std::min<size_t>(failed.size(), 20))) {
        std::printf("  case %s does not hold: %s\n", c.name.c_str(), entry(c, "note").c_str());
        for (size_t i = 0; i < std::min<size_t>(c.problems.size(), 10); ++i)
            std::printf("    %s\n", c.problems[i].c_str());
        if (c.problems.size() > 10) std::printf("    and %zu more tensors\n", c.problems.size() - 10);
    }
    if (failed.size() > 20) std::printf("  and %zu more cases\n", failed.size() - 20);
    if (malformed) throw *malformed;
    return failed.empty();
}

}  // namespace vectors

#include "dump.hpp"

void command_check(const Arguments& arguments) {
    const bool dumps = !arguments["--dump"].empty();
    require(dumps != arguments["--run"].empty() && dumps == arguments.words.empty(), "usage.words",
            "wodtem check takes vector files, or --dump FILE --run DIR");
    if (dumps) return vectors::dump_run(arguments["--dump"], {arguments["--run"]}, arguments);
    Compute compute(kernel_of(arguments), thread_count(arguments));
    size_t bad = 0;
    for (const std::string& path : arguments.words) {
        try {
            bad += !vectors::check_file(path, compute, arguments["-v"] == "yes");
        } catch (const Error& error) {
            std::fflush(stdout);
            std::fprintf(stderr, "wodtem: %s\n", error.what());
            ++bad;
        }
    }
    require(bad == 0, "check.failed", bad, " of ", arguments.words.size(), " files do not hold");
}
