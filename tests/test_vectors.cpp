// test_vectors.cpp: golden vectors hold, a wrong expected value does not, and what is no file of vectors is refused.
#include <dirent.h>
#include <unistd.h>

#include <algorithm>
#include <fstream>
#include <functional>
#include <limits>
#include <set>

#include "../data/safetensors.hpp"
#include "../mujoco_env.hpp"
#include "test.hpp"

namespace vectors {  // in wodtem.cpp, which test_wodtem.cpp includes
bool check_file(const std::string& path, Compute& compute, bool verbose);
}
int run_command_line(const std::vector<std::string>& words);

namespace {

const std::string folder = "tests/vectors/";

std::vector<std::string> vector_files() {
    std::vector<std::string> names;
    DIR* listing = ::opendir(folder.c_str());
    if (!listing) return names;
    while (const dirent* entry = ::readdir(listing)) {
        const std::string name = entry->d_name;
        if (!name.ends_with(".safetensors")) continue;
#ifndef WODTEM_MUJOCO
        if (name.starts_with("env_")) continue;
#endif
        names.push_back(folder + name);
    }
    ::closedir(listing);
    std::sort(names.begin(), names.end());
    return names;
}

struct Checked {
    bool holds = false;
    std::string text;
};

// Of a file with these bytes. Errors are thrown.
Checked check_bytes(const std::string& bytes, bool verbose = false) {
    char path[] = "/tmp/wodtem-vectors-XXXXXX";
    ::close(::mkstemp(path));
    std::ofstream(path, std::ios::binary) << bytes;
    Compute compute(best_kernel(), 1);
    Checked checked;
    std::exception_ptr problem;
    try {
        checked.text = printed([&] { checked.holds = vectors::check_file(path, compute, verbose); });
    } catch (...) {
        problem = std::current_exception();
    }
    ::unlink(path);
    if (problem) std::rethrow_exception(problem);
    return checked;
}
std::string serialise_safetensors(const TensorFile& file) { return file_start(file) + std::string(file.data()); }

Checked check(const TensorFile& file) { return check_bytes(serialise_safetensors(file)); }

// A file written by hand, as someone else might.
TensorFile hand_made(const std::string& topic) {
    TensorFile file;
    file.metadata = {{"topic", topic}, {"cases", "1"}};
    return file;
}

// y = x W^T + b: [1, 2] of [2, 1] and [2].
TensorFile small_linear() {
    TensorFile file = hand_made("linear");
    file.add("a/in/x", {2, 1}, std::array{2.0f, -1.0f});
    file.add("a/in/weight", {2, 1}, std::array{3.0f, 0.5f});
    file.add("a/in/bias", {2}, std::array{1.0f, 0.25f});
    file.add("a/out/y", {2, 2}, std::array{7.0, 1.25, -2.0, -0.25});
    return file;
}

// The file without a tensor, or with another one in its place.
TensorFile without(const TensorFile& file, const std::string& name) {
    TensorFile rest;
    rest.metadata = file.metadata;
    for (const StoredTensor& tensor : file.tensors) {
        if (tensor.name == name) continue;
        rest.index.emplace(tensor.name, rest.tensors.size());
        rest.tensors.push_back({tensor.name, tensor.dtype, tensor.shape, rest.buffer.size(), tensor.size});
        rest.buffer += file.bytes(tensor);
    }
    return rest;
}

// One case of a file.
TensorFile only(const TensorFile& file, const std::string& name) {
    TensorFile part;
    for (const auto& [key, text] : file.metadata)
        if (key.find('.') == std::string::npos || key.starts_with(name + ".")) part.metadata[key] = text;
    part.metadata["cases"] = "1";
    for (const StoredTensor& tensor : file.tensors) {
        if (!tensor.name.starts_with(name + "/")) continue;
        part.index.emplace(tensor.name, part.tensors.size());
        part.tensors.push_back({tensor.name, tensor.dtype, tensor.shape, part.buffer.size(), tensor.size});
        part.buffer += file.bytes(tensor);
    }
    return part;
}

std::vector<std::string> case_names(const TensorFile& file) {
    std::vector<std::string> names;
    for (const StoredTensor& tensor : file.tensors) {
        const std::string name = tensor.name.substr(0, tensor.name.find('/'));
        if (std::find(names.begin(), names.end(), name) == names.end()) names.push_back(name);
    }
    return names;
}

// Moves one entry by a hundredth of the tensor's largest and a bit, a whole number by 1.
template <class T>
void perturb(char* bytes, size_t count, size_t at) {
    std::vector<T> values(count);
    std::memcpy(values.data(), bytes, count * sizeof(T));
    T largest = 0;
    for (const T x : values)
        if (std::isfinite(static_cast<double>(x))) largest = std::max(largest, static_cast<T>(x < 0 ? T{} - x : x));
    T& x = values[at];
    if constexpr (std::is_floating_point_v<T>)
        x = std::isfinite(x) ? x + largest / 100 + T(1e-6) : T(0);
    else
        x = static_cast<T>(x ^ 1);
    std::memcpy(bytes, values.data(), count * sizeof(T));
}

// The file with this tensor in the place of the one that it has, or added.
template <class Values>
TensorFile with(const TensorFile& file, const std::string& name, const Shape& shape, const Values& values) {
    TensorFile changed = without(file, name);
    changed.add(name, shape, values);
    return changed;
}
TensorFile with_text(TensorFile file, const std::string& key, const std::string& text) {
    file.metadata[key] = text;
    return file;
}

std::vector<double> numbers(const TensorFile& file, const std::string& name) {
    const StoredTensor& tensor = file.find(name);
    if (tensor.dtype == DType::F64) return file.get<double>(name, tensor.shape);
    const std::vector<float> values = file.get<float>(name, tensor.shape);
    return {values.begin(), values.end()};
}

// What check says: the sentence of its error, else what it prints.
std::string told(const TensorFile& file) {
    try {
        return check(file).text;
    } catch (const Error& error) {
        return error.what();
    }
}
bool says(const TensorFile& file, const std::string& text) {
    const std::string got = told(file);
    if (got.find(text) == std::string::npos) std::printf("  expected \"%s\" in: %s\n", text.c_str(), got.c_str());
    return got.find(text) != std::string::npos;
}

// One row of logits: H = log 2, and the first step of Adam on log lambda is its rate (epsilon 1e-8 aside).
TensorFile small_objective() {
    TensorFile file = hand_made("objective");
    file.add("a/in/logits", {1, 2}, std::array{0.0, 0.0});
    file.add("a/in/actions", {1}, std::array{1.0});
    file.add("a/out/L", {}, std::array{std::log(2)});
    file.add("a/out/H", {}, std::array{std::log(2)});
    file.metadata["a.eta"] = "0";
    return file;
}

// Adam's first step is rate * sign(gradient), whatever the gradient.
TensorFile small_optimizer(const std::string& rule, double rate, double share) {
    TensorFile file = hand_made("optimizer");
    const std::array p{0.5, -0.25, 0x1p-20, 0.0}, g{2.0, -3.0, 1.0, -0.5};
    std::array<double, 4> after;
    for (size_t i = 0; i < 4; ++i) after[i] = p[i] - share * rate * (g[i] > 0 ? 1 : -1);
    file.metadata["a.optimizer"] = rule;
    file.metadata["a.learning_rate"] = std::to_string(rate * 1e12) + "e-12";
    file.add("a/in/parameter/w", {4}, p);
    file.add("a/in/gradient/w", {1, 4}, g);
    file.add("a/out/after/w", {1, 4}, after);
    return file;
}

// The grid's case of topic step with one update at a small rate, without decay: after_1 by hand from the gradient.
TensorFile small_step(double share) {
    TensorFile file = only(read_safetensors(folder + "step.safetensors"), "grid");
    const double norm = numbers(file, "grid/out/gradient_norm")[0], rate = 1e-6,
                 clip = std::min(1.0, 0.25 / (norm + 1e-6));
    const double loss = numbers(file, "grid/out/loss")[0];
    for (const char* list : {"loss", "L", "H", "gradient_norm", "log_temperature"})
        file = without(file, std::string("grid/out/") + list);
    for (const StoredTensor& tensor : std::vector<StoredTensor>(file.tensors))
        if (tensor.name.starts_with("grid/out/after_2/")) {
            const std::string name = tensor.name.substr(17);
            const std::vector<double> g = numbers(file, "grid/out/gradient/" + name);
            std::vector<double> after = numbers(file, "grid/in/parameter/" + name);
            for (size_t i = 0; i < g.size(); ++i)
                after[i] -= share * rate * clip * g[i] / (std::fabs(clip * g[i]) + 1e-8);
            file = without(file, tensor.name);
            file.add("grid/out/after_1/" + name, tensor.shape, after);
        }
    file.add("grid/out/loss", {}, std::array{loss});
    for (auto [key, text] : {std::pair{"learning_rate", "1e-6"}, {"warmup_updates", "0"}, {"clip_norm", "0.25"}})
        file.metadata[std::string("grid.") + key] = text;
    for (const char* list : {"loss", "L", "H", "gradient_norm", "log_temperature", "after_2"})
        file.metadata.erase(std::string("grid.tolerance.") + list);
    return file;
}

}  // namespace

TEST(every_golden_vector_holds) {
    std::vector<std::string> words = {"check"};
    for (const std::string& path : vector_files()) words.push_back(path);
    int status = -1;
    std::string text;
    try {
        text = printed([&] { status = run_command_line(words); });
    } catch (const Error& error) {
        report_failure(__FILE__, __LINE__, error.what());
    }
    CHECK_EQUAL(status, 0);
    if (status != 0)
        std::printf("%s", printed([&] {
                              try {
                                  run_command_line(words);
                              } catch (const Error&) {
                              }
                          }).c_str());
}

TEST(every_topic_has_its_file_and_all_together_are_below_a_megabyte) {
    std::vector<std::string> topics = {"rng",
                                       "initialisation",
                                       "returns",
                                       "linear",
                                       "layernorm",
                                       "mlp",
                                       "attention",
                                       "tokens",
                                       "policy_gaussian",
                                       "policy_discrete",
                                       "policy_deterministic",
                                       "acting",
                                       "memory_update",
                                       "memory_lookup",
                                       "memory_action",
                                       "weights",
                                       "objective",
                                       "optimizer",
                                       "sampling",
                                       "normalize",
                                       "gridworld",
                                       "step",
                                       "run"};
    for (const MujocoTask& task : mujoco_tasks)
        if (std::string(task.name) != "antmaze-umaze-diverse") topics.push_back(std::string("env_") + task.name);
    size_t bytes = 0;
    for (const std::string& topic : topics) {
        const TensorFile file = read_safetensors(folder + topic + ".safetensors");
        bytes += file.buffer.size();
        CHECK_EQUAL(file.text("topic"), topic);
        CHECK(!file.text("equations").empty());
        for (const std::string& name : case_names(file)) {
            for (const char* what : {"note", "tolerance", "source"}) CHECK(!file.text(name + "." + what).empty());
            CHECK(file.text(name + ".tolerance").find(':') != std::string::npos);  // a reason
            CHECK(file.text(name + ".source") != "self");
        }
    }
    CHECK(bytes < 1000000);
}

TEST(a_wrong_expected_value_does_not_hold) {
    const Random random{test_seed(), Stream::data_set};
    uint32_t number = 0;
    for (const std::string& path : vector_files()) {
        const TensorFile file = read_safetensors(path);
        for (const std::string& name : case_names(file)) {
            TensorFile part = only(file, name);
            CHECK(check(part).holds);
            std::vector<size_t> outputs;
            for (size_t i = 0; i < part.tensors.size(); ++i)
                if (part.tensors[i].name.starts_with(name + "/out/") && part.tensors[i].size > 0 &&
                    !part.tensors[i].name.ends_with("attn.c_attn.bias"))  // steps of the keys' bias are rounding
                    outputs.push_back(i);
            if (outputs.empty()) {  // an error is expected: another one will not do
                part.metadata[name + ".result"] = "memory.shape";
                CHECK_FAILS(file.text(name + ".result").c_str(), check(part));
                continue;
            }
            const StoredTensor& tensor = part.tensors[outputs[random.below(outputs.size(), 0, ++number)]];
            const size_t count = tensor.size / about(tensor.dtype).size, at = random.below(count, 1, number);
            char* bytes = part.buffer.data() + tensor.begin;
            if (tensor.dtype == DType::F32) perturb<float>(bytes, count, at);
            if (tensor.dtype == DType::F64) perturb<double>(bytes, count, at);
            if (tensor.dtype == DType::U8) perturb<uint8_t>(bytes, count, at);
            if (tensor.dtype == DType::I32) perturb<int32_t>(bytes, count, at);
            if (tensor.dtype == DType::U32) perturb<uint32_t>(bytes, count, at);
            if (tensor.dtype == DType::U64) perturb<uint64_t>(bytes, count, at);
            const Checked checked = check(part);
            if (checked.holds || checked.text.find(tensor.name.substr(name.size() + 1)) == std::string::npos)
                report_failure(__FILE__, __LINE__,
                               path + ": " + tensor.name + " was changed and holds: " + checked.text);
        }
    }
    CHECK(number > 200);
}

TEST(vectors_written_by_hand_are_judged) {
    CHECK(check(small_linear()).holds);
    // Other types of the same numbers.
    TensorFile file = hand_made("linear");
    file.add("a/in/x", {2, 1}, std::array<int64_t, 2>{2, -1});
    file.add("a/in/weight", {2, 1}, std::array{3.0, 0.5});
    file.add("a/in/bias", {2}, std::array{1.0f, 0.25f});
    file.add("a/out/y", {2, 2}, std::array{7.0f, 1.25f, -2.0f, -0.25f});
    file.metadata["format"] = "pt";
    CHECK(check(file).holds);
    // What float32 cannot hold is rounded, and that is said; the case is not computed in double then.
    file = without(file, "a/in/weight");
    file.add("a/in/weight", {2, 1}, std::array{3.0 + 1e-12, 0.5});
    const Checked rounded = check(file);
    CHECK(rounded.holds);
    CHECK(rounded.text.find("rounded to float32") != std::string::npos);

    // A look-up of other sizes: q = 1 + 4 and 0.25; e-hat by hand. K and epsilon by tensor and by metadata.
    TensorFile look_up = hand_made("memory_lookup");
    look_up.add("hand/in/states", {3, 2}, std::array{0.0, 0.0, 1.0, 2.5, 9.0, 9.0});
    look_up.add("hand/in/e", {3}, std::array{1.0, 3.0, 5.0});
    look_up.add("hand/in/query", {1, 2}, std::array{1.0, 2.0});
    look_up.add("hand/in/K", {}, std::array<int32_t, 1>{2});
    look_up.metadata["hand.epsilon"] = "5.5";
    look_up.add("hand/out/neighbours", {1, 2}, std::array<int64_t, 2>{1, 0});
    look_up.add("hand/out/e_hat", {1},
                std::array{(3 * std::exp(-0.25) + std::exp(-5.0)) / (std::exp(-0.25) + std::exp(-5.0))});
    CHECK(check(look_up).holds);
    look_up.metadata["hand.epsilon"] = "5";  // strict
    CHECK(!check(look_up).holds);
}

TEST(what_is_no_file_of_vectors_is_refused) {
    const TensorFile good = small_linear();
    const std::string bytes = serialise_safetensors(good);
    CHECK_FAILS("safetensors.header_length", check_bytes("not a file of vectors at all"));
    for (size_t length = 0; length < bytes.size(); length += 7) {
        try {
            check_bytes(bytes.substr(0, length));
            report_failure(__FILE__, __LINE__, "cut to " + std::to_string(length) + " bytes it holds");
        } catch (const Error&) {
        }
    }
    const auto raw = [](const std::string& header, const std::string& data) {
        std::string text(8, '\0');
        const uint64_t size = header.size();
        std::memcpy(text.data(), &size, 8);
        return text + header + data;
    };
    const std::string start = R"({"__metadata__":{"topic":"linear","cases":"1"},)";
    const auto entry = [](const std::string& name, int begin, int end) {
        return "\"" + name + R"(":{"dtype":"F32","shape":[1],"data_offsets":[)" + std::to_string(begin) + "," +
               std::to_string(end) + "]}";
    };
    CHECK_FAILS("safetensors.offsets",
                check_bytes(raw(start + entry("a/in/x", 0, 4) + "," + entry("a/out/y", 2, 6) + "}", "123456")));
    CHECK_FAILS("safetensors.offsets", check_bytes(raw(start + entry("a/in/x", 4, 8) + "}", "12345678")));
    CHECK_FAILS("safetensors.duplicate_name",
                check_bytes(raw(start + entry("a/in/x", 0, 4) + "," + entry("a/in/x", 4, 8) + "}", "12345678")));
    CHECK_FAILS("safetensors.header_length", check_bytes("\xff\xff\xff\xff\xff\xff\xff\x7f{}"));

    const auto with = [&](const std::function<void(TensorFile&)>& change) {
        TensorFile file = good;
        change(file);
        return file;
    };
    const auto metadata = [&](const char* key, const char* text) {
        return with([&](TensorFile& file) { file.metadata[key] = text; });
    };
    CHECK_FAILS("check.topic", check(metadata("topic", "linaer")));
    CHECK_FAILS("safetensors.missing", check(with([](TensorFile& file) { file.metadata.erase("topic"); })));
    CHECK_FAILS("check.count", check(metadata("cases", "2")));
    CHECK_FAILS("check.count", check(with([](TensorFile& f) { f.add("b/in/x", {1, 1}, std::array{1.0f}); })));
    CHECK_FAILS("check.case", check(metadata("b.note", "a case without tensors")));
    CHECK_FAILS("check.unknown", check(metadata("a.layuot", "in_out")));
    CHECK_FAILS("check.unknown", check(with([](TensorFile& f) { f.add("a/out/z", {1}, std::array{1.0f}); })));
    CHECK_FAILS("check.unknown", check(with([](TensorFile& f) { f.add("a/in/z", {1}, std::array{1.0f}); })));
    CHECK_FAILS("check.unknown", check(metadata("a.tolerance.z", "1e-3: of no output")));
    CHECK_FAILS("check.name", check(with([](TensorFile& f) { f.add("a/y", {1}, std::array{1.0f}); })));
    CHECK_FAILS("check.value", check(metadata("a.layout", "out-in")));
    CHECK_FAILS("check.tolerance", check(metadata("a.tolerance", "small")));
    for (const char* name : {"a/in/x", "a/in/weight", "a/in/bias", "a/out/y"})
        CHECK_FAILS("check.missing", check(without(good, name)));
    // With an upstream gradient every gradient is needed.
    CHECK_FAILS("check.missing", check(with([](TensorFile& f) {
                    f.add("a/in/upstream", {2, 2}, std::array{1.0f, 1.0f, 1.0f, 1.0f});
                })));
    TensorFile file = without(good, "a/out/y");
    file.add("a/out/y", {4}, std::array{7.0, 1.25, -2.0, -0.25});
    CHECK_FAILS("check.shape", check(file));
    file = without(good, "a/in/bias");
    file.add("a/in/bias", {3}, std::array{1.0f, 0.25f, 0.0f});
    CHECK_FAILS("check.shape", check(file));

    // The sentence names file, tensor and offset.
    try {
        check(file);
    } catch (const Error& error) {
        const std::string sentence = error.what();
        CHECK(sentence.find("/tmp/wodtem-vectors-") != std::string::npos);
        CHECK(sentence.find("\"a/in/bias\" at byte ") != std::string::npos);
        CHECK(sentence.find("[3], expected [2]") != std::string::npos);
    }
}

TEST(settings_and_sizes_of_a_vector_are_held_to_their_ranges) {
    TensorFile look_up = hand_made("memory_lookup");
    look_up.add("a/in/states", {1, 1}, std::array{0.0f});
    look_up.add("a/in/query", {1, 1}, std::array{0.0f});
    look_up.add("a/out/neighbours", {1, 1}, std::array<int32_t, 1>{0});
    CHECK(check(look_up).holds);
    const auto with = [&](const char* key, const char* text) {
        TensorFile file = look_up;
        file.metadata[key] = text;
        return file;
    };
    CHECK_FAILS("check.value", check(with("a.K", "0")));
    CHECK_FAILS("check.value", check(with("a.K", "1.5")));
    CHECK_FAILS("check.value", check(with("a.K", "two")));
    CHECK_FAILS("check.value", check(with("a.K", "1e9")));
    CHECK_FAILS("check.value", check(with("a.capacity", "0")));
    CHECK_FAILS("check.value", check(with("a.epsilon", "-1")));
    CHECK_FAILS("check.value", check(with("a.eviction", "fifo")));
    for (const float bad : {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity()}) {
        TensorFile file = without(look_up, "a/in/query");
        file.add("a/in/query", {1, 1}, std::array{bad});
        CHECK_FAILS("memory.not_finite", check(file));
    }
    // Of two trajectories the buffer keeps the second, of two steps: place 1 and step 2 are not in it.
    for (const auto& [place, step] : {std::pair{0, 1}, {1, 0}, {0, 2}}) {
        TensorFile sampling = hand_made("sampling");
        sampling.metadata["a.capacity"] = "1";
        sampling.metadata["a.sampling"] = "uniform";
        sampling.add("a/in/rewards", {5}, std::array{0.0f, 0.0f, 1.0f, 1.0f, 1.0f});
        sampling.add("a/in/lengths", {2}, std::array<int32_t, 2>{3, 2});
        sampling.add("a/out/order", {1}, std::array<int32_t, 1>{1});
        sampling.add("a/in/draws", {1, 2}, std::array<int32_t, 2>{place, step});
        sampling.add("a/out/trajectory", {1}, std::array<int32_t, 1>{0});
        sampling.add("a/out/start", {1}, std::array<int32_t, 1>{1});
        sampling.add("a/out/length", {1}, std::array<int32_t, 1>{1});
        if (place == 0 && step == 1)
            CHECK(check(sampling).holds);
        else
            CHECK_FAILS("check.value", check(sampling));
    }
    TensorFile attention = hand_made("attention");
    for (const char* name : {"a/in/q", "a/in/k", "a/in/v", "a/out/y"})
        attention.add(name, {2, 2}, std::array{0., 0., 0., 0.});
    CHECK(check(attention).holds);
    attention.add("a/in/lengths", {2}, std::array<int32_t, 2>{1, 2});
    CHECK_FAILS("check.value", check(attention));
    attention = without(attention, "a/in/lengths");
    attention.metadata["a.heads"] = "4";
    CHECK_FAILS("check.value", check(attention));
    // A width that the weights do not bear out must not be believed.
    TensorFile step = hand_made("step");
    step.metadata["a.heads"] = "1";
    step.add("a/in/parameter/embed_state.weight", {100000, 1}, std::vector<uint8_t>(100000));
    step.add("a/in/parameter/embed_action.weight", {100000, 1}, std::vector<uint8_t>(100000));
    step.add("a/in/parameter/transformer.h.0.attn.c_attn.weight", {1, 3}, std::array{1.0f, 1.0f, 1.0f});
    step.add("a/out/loss", {}, std::array{0.0f});
    CHECK_FAILS("check.shape", check(step));
}

TEST(a_run_of_vectors_takes_the_settings_of_train_within_bounds) {
    TensorFile run = hand_made("run");
    run.metadata.insert({{"a.method", "odt"}, {"a.offline_updates", "3"}, {"a.online_steps", "0"}});
    run.add("a/out/progress/updates", {1}, std::array{3.0});
    CHECK(check(run).holds);
    const auto with = [&](const char* key, const char* text) {
        TensorFile file = run;
        file.metadata[key] = text;
        return file;
    };
    CHECK(!check(with("a.offline_updates", "4")).holds);
    for (const auto& [key, text] : {std::pair{"a.offline_updates", "1001"},
                                    {"a.width", "4096"},
                                    {"a.online_steps", "200000"},
                                    {"a.batch_size", "1000000"},
                                    {"a.eval_episodes", "1000000"},
                                    {"a.seed", "-1"},
                                    {"a.data_trajectories", "1001"},
                                    {"a.table_size", "1001"},
                                    {"a.method", "ppo"}})
        CHECK_FAILS("check.value", check(with(key, text)));
    for (const auto& [key, text] :
         {std::pair{"a.K", "0"}, {"a.sampling", "all"}, {"a.heads", "3"}, {"a.method", "dt"}}) {
        TensorFile file = with(key, text);
        if (key == std::string("a.method")) file.metadata["a.online_steps"] = "100";
        CHECK_FAILS("usage.setting", check(file));
    }
    for (const char* key : {"a.task", "a.dataset", "a.colour"}) CHECK_FAILS("check.unknown", check(with(key, "data")));
}

TEST(damaged_vectors_never_crash) {
    const Random random{test_seed(), Stream::data_set};
    const std::vector<std::string> paths = vector_files();
    const char* const settings[] = {"0", "-1", "0.5", "7", "1e6", "1e300", "x"};
    int refused = 0;
    for (uint32_t round = 0; round < 1000; ++round) {
        const std::string& path = paths[round % paths.size()];
        if (path.find("env_") != std::string::npos) continue;  // a random state is no test of ours
        const TensorFile file = read_safetensors(path);
        const std::vector<std::string> cases = case_names(file);
        TensorFile part = only(file, cases[random.below(cases.size(), round, 0)]);
        StoredTensor& tensor = part.tensors[random.below(part.tensors.size(), round, 1)];
        const uint64_t kind = random.below(5, round, 2), which = random.below(part.metadata.size(), round, 5);
        if (kind == 0 && tensor.size > 0)  // a bit of the data
            part.buffer[tensor.begin + random.below(tensor.size, round, 3)] ^=
                static_cast<char>(1 << random.below(8, round, 4));
        if (kind == 1) std::reverse(tensor.shape.begin(), tensor.shape.end());
        if (kind == 2) part = without(part, std::string(tensor.name));
        if (kind == 3) std::next(part.metadata.begin(), static_cast<ptrdiff_t>(which))->second = settings[round % 7];
        if (kind == 4) {  // nothing is left of it but its rows, or not even they
            TensorFile rest = without(part, tensor.name);
            Shape shape = tensor.shape;
            shape.empty() ? shape.push_back(0) : void(shape[round % shape.size()] = 0);
            rest.add(tensor.name, shape, std::vector<float>());
            part = rest;
        }
        try {
            refused += !check(part).holds;
        } catch (const Error&) {
            ++refused;
        }
    }
    CHECK(refused > 200);
}

TEST(whole_numbers_of_vectors_are_exact_whatever_the_tolerance) {
    const std::set<std::string> whole = {"words",      "below",      "neighbours",     "count",           "stored",
                                         "accesses",   "size",       "changes",        "order",           "start",
                                         "length",     "trajectory", "sampled",        "most_likely",     "next_cell",
                                         "terminated", "action",     "window/lengths", "window/timesteps"};
    std::set<std::string> seen;
    for (const std::string& path : vector_files()) {
        const TensorFile file = read_safetensors(path);
        for (const StoredTensor& tensor : file.tensors) {
            const size_t slash = tensor.name.find("/out/");
            const std::string output = slash == std::string::npos ? "" : tensor.name.substr(slash + 5);
            if (!whole.contains(output) || about(tensor.dtype).name[0] == 'F' || tensor.size == 0) continue;
            if (!seen.insert(output + file.text("topic")).second) continue;
            const std::string name = tensor.name.substr(0, slash);
            TensorFile part = only(file, name);
            for (auto& [key, text] : part.metadata)
                if (key.starts_with(name + ".tolerance")) text = "float64 1000, float32 1000: wide";
            CHECK(check(part).holds);
            part.buffer[part.data_start + part.find(tensor.name).begin] ^= 1;
            if (check(part).holds)
                report_failure(__FILE__, __LINE__, tensor.name + " of " + path + " is off by one and holds");
        }
    }
    CHECK(seen.size() >= 19);
}

TEST(steps_of_vectors_are_judged_against_the_step) {
    for (const char* rule : {"lamb", "adamw"})
        for (const double rate : {1e-2, 1e-5, 1e-8}) {
            CHECK(check(small_optimizer(rule, rate, 1)).holds);
            for (const double share : {0.0, -1.0, 0.5, 0.99}) CHECK(!check(small_optimizer(rule, rate, share)).holds);
        }
    CHECK(check(small_step(1)).holds);
    for (const double share : {0.0, -1.0, 0.9}) CHECK(!check(small_step(share)).holds);
    const auto temperature = [](double share) {
        return with(small_objective(), "a/out/log_temperature", {}, std::array{std::log(0.1) - share * 1e-4});
    };
    CHECK(check(temperature(1)).holds);
    for (const double share : {0.0, -1.0, 0.8, 0.99}) CHECK(!check(temperature(share)).holds);
}

TEST(a_clamp_of_actions_is_seen_by_default) {
    const auto clamped = [](double at) {
        TensorFile file = hand_made("policy_gaussian");
        file.add("a/in/mean", {1, 3}, std::array{20.0, -20.0, 0.0});
        file.add("a/in/log_std", {1, 3}, std::array{0.0, 0.0, 0.0});
        file.add("a/in/data_actions", {1, 3}, std::array{1.0, -1.0, 0.5});
        file.add("a/out/clamped", {1, 3}, std::array{at, -at, 0.5});
        file.add("a/out/most_likely", {1, 3}, std::array{at, -at, 0.0});
        return file;
    };
    CHECK(check(clamped(1 - 1e-6)).holds);
    for (const double at : {1.0, 1 - 1e-5, 1 - 2e-6}) {
        CHECK(!check(without(clamped(at), "a/out/most_likely")).holds);
        CHECK(!check(without(without(clamped(at), "a/in/data_actions"), "a/out/clamped")).holds);
    }
    CHECK(check(without(without(clamped(1 - 1e-6), "a/in/data_actions"), "a/out/clamped")).holds);
}

TEST(a_tolerance_is_read_to_its_last_word) {
    const auto holds = [](const std::string& tolerance, double factor) {
        TensorFile file = with(small_linear(), "a/out/y", {2, 2},
                               std::array{7.0 * factor, 1.25 * factor, -2.0 * factor, -0.25 * factor});
        file.metadata["a.tolerance"] = tolerance;
        return check(file).holds;
    };
    CHECK(holds("exact: sums of halves", 1));
    CHECK(holds("float64 1e-3, float32 1e-3: wide", 1 + 5e-4));
    CHECK(!holds("float64 1e-3: float32 keeps its own", 1 + 5e-4));
    CHECK(!holds("float64 1e-12: float32 keeps its own", 1 + 1e-9));
    CHECK(holds("float64 1e-8, float32 1e-6, absolute 1: wide", 1.1));
    CHECK(holds("  float64  1e-3 ,float32 1e-3 : 5 spaces, a comma: and a colon", 1 + 5e-4));
    for (const char* text : {"1e-3: a number without a word",
                             "float64 1e-3, 1e-3: x",
                             "float16 3: x",
                             "float64 0.5 0.5: x",
                             "exact, float32 1: x",
                             "exactly 3: x",
                             "float64 1e-3 because of 5 things",
                             "float64 1e-3 because of 5 things: x",
                             "Float64 1e-3: x",
                             "float64 1e-3, float32 1e-3",
                             "exact",
                             ": x",
                             ",: x",
                             "float64: x",
                             "float64 1e-3, : x",
                             "float64 1, float64 2: x",
                             "float64 1, 2: x",
                             "1, float64 2: x",
                             "1 2: x",
                             "absolute inf: x",
                             "nan: x",
                             "float32 -1: x",
                             "float64 1e-10 float32 1e-5: x",
                             "",
                             "3 float64: x"})
        CHECK_FAILS("check.tolerance", check(with_text(small_linear(), "a.tolerance", text)));
}

TEST(inputs_of_vectors_that_mean_nothing_are_refused) {
    TensorFile returns = hand_made("returns");
    returns.add("a/in/rewards", {3}, std::array{1.0f, 2.0f, 3.0f});
    returns.add("a/out/g", {3}, std::array{6.0, 5.0, 3.0});
    returns.add("a/out/d", {3}, std::array{6.0, 5.0, 3.0});
    returns.metadata["a.gamma"] = "1";
    CHECK(check(returns).holds);
    CHECK_FAILS("check.value", check(with(returns, "a/in/lengths", {0}, std::vector<int>())));
    CHECK_FAILS("check.value", check(with(returns, "a/in/lengths", {1}, std::array{2})));
    CHECK_FAILS("check.value", check(with(returns, "a/in/lengths", {2}, std::array{2, 2})));
    // Rewards that float32 cannot hold are rounded, and the sums then held to float32's tolerance.
    CHECK(check(with(returns, "a/in/rewards", {3}, std::array{1.0 + 1e-9, 2.0, 3.0})).holds);
    CHECK(!check(with(returns, "a/in/rewards", {3}, std::array{1.0 + 1e-3, 2.0, 3.0})).holds);

    const TensorFile objective = small_objective();
    CHECK(check(objective).holds);
    for (const double w : {2.0, -1.0})
        CHECK_FAILS("check.value", check(with(objective, "a/in/weights", {1}, std::array{w})));
    CHECK_FAILS("check.value", check(with(objective, "a/in/eta", {}, std::array{0.0})));  // given twice

    TensorFile gaussian = hand_made("policy_gaussian");
    gaussian.add("a/in/mean", {1, 1}, std::array{0.0});
    gaussian.add("a/in/log_std", {1, 1}, std::array{0.0});
    gaussian.add("a/out/log_prob", {1}, std::array{-0.5 * std::log(2 * 3.14159265358979323846)});
    CHECK(check(with(gaussian, "a/in/actions", {1, 1}, std::array{0.0})).holds);
    for (const double a : {1.0, -1.0, 2.0})
        CHECK_FAILS("check.value", check(with(gaussian, "a/in/actions", {1, 1}, std::array{a})));

    TensorFile optimizer = small_optimizer("lamb", 1e-2, 1);
    optimizer = with(with(optimizer, "a/in/parameter/w", {}, std::array{0.5}), "a/in/gradient/w", {1}, std::array{2.0});
    CHECK_FAILS("check.shape", check(with(optimizer, "a/out/after/w", {1}, std::array{0.49})));

    const TensorFile step = only(read_safetensors(folder + "step.safetensors"), "grid");
    const std::vector<double> loss = numbers(step, "grid/out/loss");
    CHECK(check(with(step, "grid/out/loss", {}, std::array{loss[0]})).holds);
    CHECK_FAILS("check.shape", check(with(step, "grid/out/loss", {0}, std::vector<double>())));
    CHECK_FAILS("check.shape", check(with(step, "grid/out/loss", {1}, std::array{loss[0]})));
    CHECK_FAILS("check.shape", check(with(step, "grid/out/H", {1}, std::array{numbers(step, "grid/out/H")[0]})));

    CHECK_FAILS("check.value", check(with_text(step, "grid.updates", "1001")));

    TensorFile none;
    none.metadata = {{"topic", "linear"}, {"cases", "0"}};
    CHECK_FAILS("check.count", check(none));
}

TEST(a_vector_that_is_refused_says_which_tensor_and_entry) {
    const float nan = std::numeric_limits<float>::quiet_NaN();
    TensorFile returns = hand_made("returns");
    returns.add("a/in/rewards", {4}, std::array{1.0f, 2.0f, 3.0f, -nan});
    returns.add("a/in/lengths", {2}, std::array{1, 3});
    returns.add("a/out/g", {4}, std::array{0.0, 0.0, 0.0, 0.0});
    CHECK(says(returns, "tensor \"a/in/rewards\" at byte "));
    CHECK(says(returns, ": entry [3] is nan"));
    const TensorFile step = only(read_safetensors(folder + "step.safetensors"), "grid");
    std::vector<double> states = numbers(step, "grid/in/states");
    states[5] = std::numeric_limits<double>::infinity();
    CHECK(says(with(step, "grid/in/states", step.find("grid/in/states").shape, states), "/in/states\" at byte "));
    CHECK(says(with(step, "grid/in/states", step.find("grid/in/states").shape, states), ": entry [2, 1] is inf"));
    const TensorFile action = only(read_safetensors(folder + "memory_action.safetensors"),
                                   case_names(read_safetensors(folder + "memory_action.safetensors"))[0]);
    for (const StoredTensor& tensor : action.tensors)
        if (tensor.name.ends_with("/in/uniform")) {
            const std::vector<double> ones(tensor.size / about(tensor.dtype).size, 1);
            CHECK(says(with(action, tensor.name, tensor.shape, ones), tensor.name + "\" at byte "));
            CHECK(says(with(action, tensor.name, tensor.shape, ones), "entry [0] is 1, expected a number from 0"));
        }
    TensorFile objective = small_objective();
    objective.metadata.erase("a.eta");
    objective.add("a/out/log_temperature", {}, std::array{0.0});
    CHECK(says(objective, "neither metadata entry \"a.eta\" nor tensor \"a/in/eta\""));
    TensorFile look_up = hand_made("memory_lookup");
    look_up.add("a/in/states", {1, 1}, std::array{0.0f});
    look_up.add("a/in/query", {1, 1}, std::array{1.0f});
    look_up.add("a/out/e_hat", {1}, std::array{-nan});
    CHECK(says(look_up, "file nan, wodtem 0, which must be equal"));
    CHECK(check(with_text(with(look_up, "a/out/e_hat", {1}, std::array{0.0}), "a.epsilon", "inf")).holds);
    // A case that must raise an error: none comes, another one comes, and outputs are of no use.
    const TensorFile raises = with_text(without(look_up, "a/out/e_hat"), "a.result", "memory.not_finite");
    CHECK(!check(raises).holds && says(raises, "file: the error memory.not_finite; wodtem: no error"));
    CHECK(check(with(raises, "a/in/query", {1, 1}, std::array{nan})).holds);
    CHECK(says(with_text(with(raises, "a/in/query", {1, 1}, std::array{nan}), "a.result", "memory.shape"),
               "file: the error memory.shape; wodtem: memory.not_finite: "));
    CHECK_FAILS("check.unknown", check(with_text(look_up, "a.result", "memory.not_finite")));
    // A file that was cut off: where.
    const std::string bytes = serialise_safetensors(small_linear());
    for (const auto& [length, part] : {std::pair{size_t{5}, "offset 0: "},
                                       {size_t{100}, "offset 8: "},
                                       {bytes.size() - 4, "\"a/out/y\" at byte "}}) {
        try {
            check_bytes(bytes.substr(0, length));
        } catch (const Error& error) {
            CHECK(std::string(error.what()).find(part) != std::string::npos);
        }
    }
    CHECK(says(with(small_linear(), "a/in/bias", Shape(1000, 1), std::array{1.0f}), "... of 1000]"));
}

// A message must say whose number is whose: "got" and "expected" are read either way round.
TEST(check_names_the_number_of_the_file_and_that_of_wodtem) {
    const TensorFile wrong = with(small_linear(), "a/out/y", {2, 2}, std::array{7.0, 1.5, -2.0, -0.25});
    const std::string text = check_bytes(serialise_safetensors(wrong), true).text;
    for (const char* part : {"out/y[0, 1] in float64: file 1.5, wodtem 1.25, allowed difference ",
                             "file: the number in the file; wodtem: what this program computes",
                             "Begin with the first case", "    file y ", "    wodtem float64 ", "    wodtem float32 "})
        if (text.find(part) == std::string::npos) report_failure(__FILE__, __LINE__, std::string(part) + ": " + text);
    CHECK(text.find("got") == std::string::npos);
    CHECK(text.find("expected") == std::string::npos);
    const TensorFile exact = with_text(wrong, "a.tolerance", "exact: sums of halves");
    CHECK(says(exact, "file 1.5, wodtem 1.25, which must be equal"));
    const TensorFile two = with(small_linear(), "a/out/y", {2, 2}, std::array{7.0, 1.5, -2.0, -0.5});
    CHECK(says(two, "; 1 more differ"));
    CHECK(check(small_linear()).text.find("computes") == std::string::npos);  // nothing to explain
}

// What each of these cases is for: the ports that are wrong and pass all others. The orders of ties must be such that
// an unstable sort goes wrong: more than 16 entries of one distance among those that count.
TEST(golden_vectors_hold_what_wrong_ports_would_pass_without) {
    const TensorFile look_up = read_safetensors(folder + "memory_lookup.safetensors");
    const std::vector<double> distances = numbers(look_up, "ties_many/out/distances");
    CHECK_EQUAL(distances.size(), size_t{40});  // 2 queries of K = 20
    int longest = 0, run = 0;
    for (size_t i = 1; i < 20; ++i) longest = std::max(longest, run = distances[i] == distances[i - 1] ? run + 1 : 0);
    CHECK(longest + 1 >= 10);
    const StoredTensor& states = look_up.find("ties_many/in/states");
    const std::vector<double> all = numbers(look_up, "ties_many/in/states");
    const auto far = [&](size_t row) {
        double sum = 0;
        for (size_t i = 0; i < 4; ++i) sum += all[4 * row + i] * all[4 * row + i];
        return sum > 1;
    };
    size_t equal = 0;
    for (size_t row = 0; row < states.shape[0]; ++row) equal += far(row);
    CHECK(equal > 40);

    const TensorFile optimizer = read_safetensors(folder + "optimizer.safetensors");
    const auto norm = [](const std::vector<double>& x) {
        double sum = 0;
        for (const double each : x) sum += each * each;
        return std::sqrt(sum);
    };
    const std::vector<double> value = numbers(optimizer, "large_norms/in/parameter/norm_90_small_steps");
    std::vector<double> step = value;
    const std::vector<double> after = numbers(optimizer, "large_norms/out/after/norm_90_small_steps");
    for (size_t i = 0; i < step.size(); ++i) step[i] -= after[i];
    CHECK(norm(value) > 80);
    CHECK(std::fabs(norm(step) / norm(value) - 0.0625) < 1e-6);  // LAMB: the learning rate, as a part of the weights
    for (const double x : numbers(optimizer, "clip_leaves_small_gradients/out/norm")) CHECK(x < 0.125);
    CHECK_EQUAL(optimizer.text("clip_leaves_small_gradients.clip_norm"), "0.25");
}

TEST(a_wrong_episode_of_acting_does_not_hold) {
    const TensorFile file = read_safetensors(folder + "acting.safetensors");
    const TensorFile likely = only(file, "gaussian_most_likely"), sampled = only(file, "gaussian_sampled"),
                     moves = only(file, "categorical_sampled");
    for (const TensorFile* part : {&likely, &sampled, &moves}) CHECK(check(*part).holds);
    // Outputs that may be left out do not hide a wrong action.
    const auto without_windows = [](TensorFile part) {
        for (const StoredTensor& tensor : std::vector<StoredTensor>(part.tensors))
            if (tensor.name.find("/out/") != std::string::npos && !tensor.name.ends_with("/out/action"))
                part = without(part, tensor.name);
        for (const auto& [key, text] : std::map<std::string, std::string>(part.metadata))
            if (key.find(".tolerance.") != std::string::npos && !key.ends_with(".action")) part.metadata.erase(key);
        return part;
    };
    CHECK(check(without_windows(likely)).holds);
    for (const auto& [key, text] : {std::pair{"eval_context", "2"},
                                    {"eval_context", "4"},
                                    {"context_length", "2"},
                                    {"target", "3.5"},
                                    {"reward_scale", "0.25"}})
        CHECK(!check(without_windows(with_text(likely, std::string("gaussian_most_likely.") + key, text))).holds);
    CHECK(check(without_windows(with_text(likely, "gaussian_most_likely.context_length", "3"))).holds);
    for (const auto& [key, text] : {std::pair{"seed", "6"}, {"episode", "0"}}) {
        CHECK(!check(without_windows(with_text(sampled, std::string("gaussian_sampled.") + key, text))).holds);
        CHECK(!check(with_text(moves, std::string("categorical_sampled.") + key, text)).holds);
    }
    CHECK_FAILS("check.missing", check(without(likely, "gaussian_most_likely/out/action")));
    CHECK_FAILS("check.shape", check(with(likely, "gaussian_most_likely/in/rewards", {1}, std::array{1.0})));
    CHECK_FAILS("check.value", check(with_text(likely, "gaussian_most_likely.eval_context", "0")));
    CHECK_FAILS("check.value", check(with_text(likely, "gaussian_most_likely.act", "mean")));
    CHECK_FAILS("check.unknown", check(with_text(likely, "gaussian_most_likely.seed", "1")));  // nothing is drawn
}

TEST(start_values_of_another_seed_or_size_do_not_hold) {
    const TensorFile part = only(read_safetensors(folder + "initialisation.safetensors"), "gaussian");
    CHECK(check(part).holds);
    for (const auto& [key, text] : {std::pair{"seed", "8"}, {"projected_dim", "4"}})
        CHECK(check(with_text(part, std::string("gaussian.") + key, text)).holds == (text[0] == '4'));
    for (const auto& [key, text] : {std::pair{"width", "4"}, {"state_dim", "2"}, {"projected_dim", "3"}})
        CHECK_FAILS("check.shape", check(with_text(part, std::string("gaussian.") + key, text)));
    CHECK_FAILS("check.missing", check(with_text(part, "gaussian.layers", "3")));
    CHECK_FAILS("check.unknown", check(with_text(part, "gaussian.layers", "1")));
    for (const auto& [key, text] : {std::pair{"width", "1e6"}, {"layers", "0"}, {"seed", "-1"}, {"head", "linear"}})
        CHECK_FAILS("check.value", check(with_text(part, std::string("gaussian.") + key, text)));
}

TEST(a_case_that_is_refused_hides_no_other) {
    TensorFile file = hand_made("returns");
    file.metadata["cases"] = "4";
    for (const std::string name : {"a", "b", "y", "z"}) {
        file.add(name + "/in/rewards", {1}, std::array{name == "b" || name == "y" ? NAN : 1.0f});
        file.add(name + "/out/g", {1}, std::array{name == "a" ? 0.0 : 1.0});
        file.add(name + "/out/d", {1}, std::array{name == "z" ? 0.0 : 1.0});
    }
    char path[] = "/tmp/wodtem-vectors-XXXXXX";
    ::close(::mkstemp(path));
    std::ofstream(path, std::ios::binary) << serialise_safetensors(file);
    const std::string text = printed([&] {
        try {
            run_command_line({"check", path});
        } catch (const Error& error) {
            std::printf("%s\n", error.what());
        }
    });
    ::unlink(path);
    for (const char* part : {"4 cases, 4 failed", "case a does not hold", "out/g[0] in float64: file 0, wodtem 1",
                             "case z does not hold", "out/d[0]", "\"b/in/rewards\"", "\"y/in/rewards\""})
        if (text.find(part) == std::string::npos) report_failure(__FILE__, __LINE__, std::string(part) + ": " + text);
}
