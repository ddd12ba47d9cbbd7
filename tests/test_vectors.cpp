// test_vectors.cpp: golden vectors hold, a wrong expected value does not, and what is no file of vectors is refused.
#include <dirent.h>
#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <fstream>
#include <functional>
#include <limits>

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

// What f prints to stdout and stderr.
std::string printed(const std::function<void()>& f) {
    char path[] = "/tmp/wodtem-vectors-XXXXXX";
    const int file = ::mkstemp(path), out = ::dup(1), err = ::dup(2);
    std::fflush(stdout);
    ::dup2(file, 1), ::dup2(file, 2);
    std::exception_ptr problem;
    try {
        f();
    } catch (...) {
        problem = std::current_exception();
    }
    std::fflush(stdout);
    ::dup2(out, 1), ::dup2(err, 2);
    const std::string text = read_file(path);
    ::close(file), ::close(out), ::close(err), ::unlink(path);
    if (problem) std::rethrow_exception(problem);
    return text;
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
    Compute compute(choose_kernel("auto"), 1);
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
    std::vector<std::string> topics = {
        "rng",           "returns",       "linear",          "layernorm",       "mlp",
        "attention",     "tokens",        "policy_gaussian", "policy_discrete", "policy_deterministic",
        "memory_update", "memory_lookup", "memory_action",   "weights",         "objective",
        "optimizer",     "sampling",      "normalize",       "gridworld",       "step"};
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
