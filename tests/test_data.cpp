// test_data.cpp: data/safetensors.hpp against a file written by hand, published checksums and damage of every kind;
// data/figures.hpp for well-formed XML and honest numbers.
#include <sys/resource.h>
#include <sys/wait.h>

#include <csignal>
#include <filesystem>
#include <new>
#include <set>

#include "../data/figures.hpp"
#include "../data/safetensors.hpp"
#include "test.hpp"

// Allocations of this thread until one fails; below 0: none does. The functions are not inlined, or GCC would see a
// pointer of `new` in free().
static thread_local long allocations_left = -1;

[[gnu::noinline]] void* operator new(size_t size, const std::nothrow_t&) noexcept {
    return allocations_left >= 0 && allocations_left-- == 0 ? nullptr : std::malloc(size);
}
[[gnu::noinline]] void* operator new(size_t size) {
    void* const memory = operator new(size, std::nothrow);
    return memory ? memory : throw std::bad_alloc();
}
[[gnu::noinline]] void operator delete(void* memory) noexcept { std::free(memory); }
[[gnu::noinline]] void operator delete(void* memory, size_t) noexcept { std::free(memory); }
[[gnu::noinline]] void operator delete(void* memory, const std::nothrow_t&) noexcept { std::free(memory); }

namespace {

// Calls work() until it makes no further allocation that could fail; each failure must come out as std::bad_alloc.
// Returns how many there were; after each, and at the end, holds() must be true.
int fail_each_allocation(const std::function<void()>& work, const std::function<bool()>& holds) {
    for (int failures = 0;; ++failures) {
        allocations_left = failures;
        bool failed = false;
        try {
            work();
        } catch (const std::bad_alloc&) {
            failed = true;
        }
        const bool all_made = allocations_left >= 0;
        allocations_left = -1;
        CHECK(failed != all_made && holds());
        if (all_made || failed_checks() > 0) return failures;
    }
}

// A folder of this test program, removed at its end.
struct Folder {
    std::filesystem::path path = std::filesystem::temp_directory_path() / ("wodtem_test_" + std::to_string(::getpid()));
    Folder() { std::filesystem::create_directories(path); }
    ~Folder() { std::filesystem::remove_all(path); }
    std::string operator/(const std::string& name) const { return (path / name).string(); }
    std::set<std::string> names() const {  // of all below it
        std::set<std::string> found;
        for (const auto& entry : std::filesystem::recursive_directory_iterator(path))
            found.insert(entry.path().lexically_relative(path));
        return found;
    }
};

// The eight bytes of a length, then the header, then the data: nothing of ours is used.
std::string raw_file(const std::string& header, const std::string& data) {
    std::string bytes;
    for (int i = 0; i < 8; ++i) bytes += static_cast<char>(header.size() >> (8 * i) & 255);
    return bytes + header + data;
}

std::string entry(const std::string& dtype, const std::string& shape, const std::string& offsets) {
    return "{\"dtype\":\"" + dtype + "\",\"shape\":" + shape + ",\"data_offsets\":" + offsets + "}";
}

TensorFile small_file() {
    TensorFile file;
    file.metadata["config"] = "{\"K\": 20}\n\t\\ \u00e9";
    file.metadata["format"] = "pt";
    file.add("weight", {2, 3}, std::vector<float>{1, -2, 3, 0.5f, 0, 1e30f});
    file.add("mask", {3}, std::vector<uint8_t>{1, 0, 255});
    file.add("empty", {0, 7}, std::vector<double>{});
    file.add("step", {}, std::array{uint64_t{1} << 60});
    file.add("delta", {1}, std::array{int64_t{-5}});
    file.add("count", {1, 1}, std::array{uint32_t{7}});
    return file;
}

TensorFile parse(const std::string& bytes) { return parse_safetensors(bytes, "test"); }

std::string serialise_safetensors(const TensorFile& file) { return file_start(file) + std::string(file.data()); }

}  // namespace

TEST(crc32_gives_the_published_check_value) {
    CHECK_EQUAL(crc32("123456789"), 0xCBF43926u);  // the "check" value of CRC-32/ISO-HDLC
    CHECK_EQUAL(crc32(""), 0u);
    CHECK_EQUAL(crc32(std::string(32, '\0')), 0x190A55ADu);  // zlib.crc32(bytes(32))
}

// Bit by bit, as CRC-32/ISO-HDLC is defined, over the header with its own digits, bytes 41 to 48, as zeros.
TEST(the_checksum_of_a_header_is_that_of_its_definition) {
    TensorFile file;
    file.metadata = {{"a key", "a text"}};
    file.add("a", {2}, std::array{1.0f, 2.0f});
    std::string header = file_start(file);
    const std::string digits = header.substr(41, 8);
    header.replace(41, 8, "00000000");
    uint32_t crc = 0xFFFFFFFF;
    for (const char byte : header) {
        crc ^= static_cast<uint8_t>(byte);
        for (int bit = 0; bit < 8; ++bit) crc = crc % 2 == 1 ? crc >> 1 ^ 0xEDB88320 : crc >> 1;
    }
    CHECK_EQUAL(digits, hex8(~crc));
}

TEST(crc32_of_parts_equals_crc32_of_the_whole) {
    std::string text;
    for (int i = 0; i < 100; ++i) text += static_cast<char>(i * 37 % 251);
    for (size_t cut = 0; cut <= text.size(); ++cut)
        CHECK_EQUAL(crc32(text.substr(cut), crc32(text.substr(0, cut))), crc32(text));
}

TEST(safetensors_written_by_hand_is_read) {
    // As others write it: no checksums, other order than the data, white space, escapes.
    const std::string header = "{ \"b\\u00e9\\n\" :" + entry("U8", "[ 2 ]", "[4, 6]") +
                               ",\n\"a\":" + entry("F32", "[]", "[0,4]") +
                               ",\"__metadata__\":{\"k\":\"\\\"\\\\\\/\\u20AC\\u07ff\\u0800\"}}   ";
    CHECK_FAILS("safetensors.name", parse(raw_file(header, "")));  // a line break in a name
    std::string good = header;
    good.replace(good.find("\\n"), 2, "");
    const TensorFile file = parse(raw_file(good, std::string("\0\0\xC0\x3F", 4) + "xy"));
    CHECK_EQUAL(file.tensors.size(), size_t{2});
    CHECK_EQUAL(file.tensors[0].name, "a");
    CHECK_EQUAL(file.get<float>("a", {})[0], 1.5f);
    CHECK_EQUAL(file.get<uint8_t>("b\u00e9", {2})[1], 'y');
    CHECK_EQUAL(file.text("k"), "\"\\/\u20ac\u07ff\u0800");  // three bytes from U+0800 on
    CHECK(parse(raw_file("{}", "")).tensors.empty());
}

// Bytes from safetensors 0.8.0 with NumPy and ml_dtypes: 1, -2.5, 65504, 2^-24, the greatest subnormal, inf; the same
// but for 3.3895314e38 and 2^-133 as bfloat16; 0.1 and 1e-300 as F64, of which the second becomes 0.
TEST(safetensors_of_16_and_64_bits_are_converted_to_float) {
    const std::string halves("\x00\x3c\x00\xc1\xff\x7b\x01\x00\xff\x03\x00\x7c", 12);
    const std::string bfloats("\x80\x3f\x20\xc0\x7f\x7f\x01\x00\xc0\xff\x80\xff", 12);
    const double doubles[] = {0.1, 1e-300, -3e38, NAN};
    const std::string header = "{\"h\":" + entry("F16", "[2,3]", "[0,12]") +
                               ",\"b\":" + entry("BF16", "[6]", "[12,24]") +
                               ",\"d\":" + entry("F64", "[4]", "[24,56]") + ",\"e\":" + entry("F16", "[0]", "[56,56]") +
                               ",\"u\":" + entry("U8", "[1]", "[56,57]") + "}";
    std::string data = halves + bfloats + std::string(reinterpret_cast<const char*>(doubles), 32) + "x";
    const TensorFile file = parse(raw_file(header, data));
    CHECK(file.get_floats("h", {2, 3}) == (std::vector<float>{1, -2.5f, 65504, 0x1p-24f, 1023 * 0x1p-24f, INFINITY}));
    const std::vector<float> b = file.get_floats("b", {6}), d = file.get_floats("d", {4});
    CHECK(b[0] == 1 && b[1] == -2.5f && b[2] == 0x1.fep127f && b[3] == 0x1p-133f && std::isnan(b[4]) &&
          b[5] == -INFINITY);
    CHECK(d[0] == 0.1f && d[1] == 0 && d[2] == -3e38f && std::isnan(d[3]));
    CHECK_FAILS("safetensors.dtype", file.get_floats("u", {1}));
    CHECK_FAILS("safetensors.dtype", file.get<float>("h", {2, 3}));  // where no conversion is wanted
    CHECK_FAILS("safetensors.shape", file.get_floats("b", {3, 2}));
    CHECK_FAILS("safetensors.missing", file.get_floats("x", {}));
    data.replace(24, 8, std::string("\0\0\0\xe0\xff\xff\xef\x47", 8));  // FLT_MAX
    CHECK_EQUAL(parse(raw_file(header, data)).get_floats("d", {4})[0], 0x1.fffffep127f);
    data.replace(24, 8, std::string("\0\0\0\xf0\xff\xff\xef\x47", 8));  // half a step above: rounds to infinity
    CHECK_FAILS("safetensors.range", parse(raw_file(header, data)).get_floats("d", {4}));
}

TEST(safetensors_round_trip_gives_the_same_bytes) {
    const TensorFile file = small_file();
    const std::string bytes = serialise_safetensors(file);
    const TensorFile again = parse(bytes);
    CHECK(serialise_safetensors(again) == bytes);
    CHECK(again.metadata == file.metadata);
    CHECK_EQUAL(file.data_start, size_t{0});
    CHECK_EQUAL(again.data_start % 8, size_t{0});
    CHECK(again.get<float>("weight", {2, 3}) == (std::vector<float>{1, -2, 3, 0.5f, 0, 1e30f}));
    CHECK(again.get<double>("empty", {0, 7}).empty());
    CHECK_EQUAL(again.get<uint64_t>("step", {})[0], uint64_t{1} << 60);
    CHECK_EQUAL(again.get<int64_t>("delta", {1})[0], -5);
    CHECK_EQUAL(again.get<uint32_t>("count", {1, 1})[0], 7u);
    CHECK(again.has("mask") && !again.has("musk"));
    CHECK(serialise_safetensors(parse(serialise_safetensors({}))) == serialise_safetensors({}));
}

TEST(safetensors_get_names_what_is_wrong) {
    const TensorFile file = parse(serialise_safetensors(small_file()));
    CHECK_FAILS("safetensors.missing", file.get<float>("bias", {3}));
    CHECK_FAILS("safetensors.missing", file.text("seed"));
    CHECK_FAILS("safetensors.dtype", file.get<double>("weight", {2, 3}));
    CHECK_FAILS("safetensors.shape", file.get<float>("weight", {3, 2}));
    std::vector<float> five(5);
    CHECK_FAILS("safetensors.shape", file.read_into(std::span(five), "weight", {2, 3}));
    try {
        file.get<float>("weight", {6});
    } catch (const Error& error) {
        CHECK_EQUAL(std::string(error.what()),
                    "test: tensor \"weight\" has shape [2, 3], expected [6] (6 elements); made with other settings?");
    }
}

TEST(archives_give_back_what_they_took_and_demand_the_size_that_they_are_given) {
    TensorFile file;
    Saver saver{file};
    const std::vector<float> mean = {1, 2, 3};
    saver("free", mean);
    saver("mean", mean, 3);
    saver("none", std::vector<float>{}, 0);
    saver("step", uint64_t{7});
    CHECK_FAILS("safetensors.shape", saver("other", mean, 4));
    const TensorFile again = parse(serialise_safetensors(file));
    Loader loader{again};
    std::vector<float> empty, kept(3), shorter(2);
    loader("free", empty);
    CHECK(empty == mean);
    loader("free", kept);
    CHECK(kept == mean);
    CHECK_FAILS("safetensors.shape", loader("free", shorter));
    uint64_t step = 0;
    loader("step", step);
    CHECK_EQUAL(step, uint64_t{7});
    for (std::vector<float> values : {std::vector<float>{}, std::vector<float>(3), std::vector<float>(9)}) {
        loader("mean", values, 3);  // the given size decides, not that of the vector
        CHECK(values == mean);
        loader("none", values, 0);
        CHECK(values.empty());
        for (const size_t size : {0, 2, 4}) CHECK_FAILS("safetensors.shape", loader("mean", values, size));
        CHECK_FAILS("safetensors.shape", loader("none", values, 1));
    }
    std::vector<double> doubles;
    CHECK_FAILS("safetensors.dtype", loader("mean", doubles, 3));
    CHECK_FAILS("safetensors.missing", loader("deviation", empty, 3));
}

TEST(safetensors_refuses_what_it_could_not_read_back) {
    TensorFile file;
    file.add("a", {1}, std::array{1.0f});
    CHECK_FAILS("safetensors.duplicate_name", file.add("a", {1}, std::array{1.0f}));
    CHECK_FAILS("safetensors.shape", file.add("b", {2}, std::array{1.0f}));
    CHECK_FAILS("safetensors.shape", file.add("b", {1ull << 63, 4, 0}, std::vector<float>{}));
    CHECK_FAILS("safetensors.name", file.add("b\x1b[2J", {1}, std::array{1.0f}));
    CHECK_FAILS("safetensors.name", file.add("__metadata__", {1}, std::array{1.0f}));
    for (const char* text : {"\xff", "\xc0\xaf", "\xed\xa0\x80", "\xf4\x90\x80\x80", "\xe2\x82"}) {  // not UTF-8
        file.metadata["path"] = text;
        CHECK_FAILS("safetensors.metadata", serialise_safetensors(file));
    }
    file.metadata = {{"crc32.header", "00000000"}};
    CHECK_FAILS("safetensors.metadata", serialise_safetensors(file));
    file.metadata = {{"path", "\u00e9\u20ac\U0001f600"}};
    CHECK_EQUAL(parse(serialise_safetensors(file)).text("path"), "\u00e9\u20ac\U0001f600");
}

TEST(safetensors_refuses_every_truncation) {
    const std::string bytes = serialise_safetensors(small_file());
    for (size_t size = 0; size < bytes.size(); ++size)
        CHECK_FAILS("safetensors.truncated", parse(bytes.substr(0, size)));
    CHECK_FAILS("safetensors.trailing", parse(bytes + '\0'));
}

TEST(safetensors_refuses_every_flipped_bit) {
    for (const TensorFile& file : {small_file(), TensorFile{}}) {
        std::string bytes = serialise_safetensors(file);
        for (size_t bit = 0; bit < 8 * bytes.size(); ++bit) {
            bytes[bit / 8] = static_cast<char>(bytes[bit / 8] ^ (1 << bit % 8));
            bool refused = false;
            try {
                parse(bytes);
            } catch (const Error&) {
                refused = true;
            }
            if (!refused) report_failure(__FILE__, __LINE__, "accepted with bit " + std::to_string(bit) + " flipped");
            bytes[bit / 8] = static_cast<char>(bytes[bit / 8] ^ (1 << bit % 8));
        }
    }
}

TEST(safetensors_never_crashes_on_damaged_bytes) {
    // Checksums would hide the parser: a header without them, with 1 to 4 bytes replaced by likely ones.
    const std::string header = "{\"__metadata__\":{\"k\":\"\\u00e9\\n\"},\"a\":" + entry("F32", "[2,1]", "[0,8]") +
                               ",\"b\":" + entry("U8", "[0]", "[8,8]") + "}";
    const std::string good = raw_file(header, "12345678"), likely = "{}[]\",:\\u0129 eF\xff\x7f";
    const Random random{test_seed(), 9};
    int accepted = 0;
    for (uint32_t round = 0; round < 20000; ++round) {
        std::string bytes = good;
        for (uint32_t i = 0; i <= round % 4; ++i)
            bytes[random.below(bytes.size(), round, 2 * i)] = likely[random.below(likely.size(), round, 2 * i + 1)];
        try {
            serialise_safetensors(parse(bytes));
            ++accepted;
        } catch (const Error&) {
        }
    }
    CHECK(accepted > 0 && accepted < 20000);
}

TEST(safetensors_names_each_way_a_header_can_be_wrong) {
    const std::string a = "\"a\":" + entry("U8", "[4]", "[0,4]");
    const struct {
        const char* id;
        std::string header;
    } cases[] = {
        {"safetensors.json", ""},
        {"safetensors.json", "[]"},
        {"safetensors.json", "{" + a},
        {"safetensors.json", "{" + a + ",}"},
        {"safetensors.json", "{" + a + "} x"},
        {"safetensors.json", "{\"\xff\":1}"},
        {"safetensors.json", "{\"a\tb\":1}"},
        {"safetensors.json", "{\"\\x\":1}"},
        {"safetensors.json", "{\"\\ud800\":1}"},
        {"safetensors.json", "{\"\\u00g0\":1}"},
        {"safetensors.json", "{\"\\u00"},
        {"safetensors.json", "{\"__metadata__\":{\"k\":1}}"},
        {"safetensors.json", "{\"a\":" + std::string(100000, '[')},
        {"safetensors.json", "{\"a\":{\"dtype\":\"U8\",\"shape\":[4]}}"},
        {"safetensors.json", "{\"a\":{\"dtype\":\"U8\",\"shape\":[4],\"data_offsets\":[0,4],\"more\":1}}"},
        {"safetensors.json", "{\"a\":" + entry("U8", "[4]", "[0,2,4]") + "}"},
        {"safetensors.json", "{\"a\":" + entry("U8", "[-4]", "[0,4]") + "}"},
        {"safetensors.json", "{\"a\":" + entry("U8", "[4.0]", "[0,4]") + "}"},
        {"safetensors.json", "{\"a\":" + entry("U8", "[04]", "[0,4]") + "}"},
        {"safetensors.json", "{\"a\":" + entry("U8", "[18446744073709551616]", "[0,4]") + "}"},
        {"safetensors.duplicate_name", "{" + a + "," + a + "}"},
        {"safetensors.duplicate_name", "{\"__metadata__\":{},\"__metadata__\":{}," + a + "}"},
        {"safetensors.duplicate_name", "{\"__metadata__\":{\"k\":\"1\",\"\\u006b\":\"2\"}," + a + "}"},
        {"safetensors.duplicate_name", "{\"a\":{\"dtype\":\"U8\",\"dtype\":\"U8\"}}"},
        {"safetensors.name", "{\"a\\u001b\":" + entry("U8", "[4]", "[0,4]") + "}"},
        {"safetensors.dtype", "{\"a\":" + entry("F8_E4M3", "[4]", "[0,4]") + "}"},
        {"safetensors.shape", "{\"a\":" + entry("U8", "[3]", "[0,4]") + "}"},
        {"safetensors.shape", "{\"a\":" + entry("F32", "[4]", "[0,4]") + "}"},
        {"safetensors.shape", "{\"a\":" + entry("F32", "[4611686018427387905]", "[0,4]") + "}"},  // 2^62 + 1, times 4
        {"safetensors.offsets", "{\"a\":" + entry("U8", "[4]", "[4,0]") + "}"},
        {"safetensors.offsets", "{" + a + ",\"b\":" + entry("U8", "[2]", "[2,4]") + "}"},
        {"safetensors.offsets", "{\"a\":" + entry("U8", "[2]", "[2,4]") + "}"},
        {"safetensors.truncated", "{\"a\":" + entry("U8", "[5]", "[0,5]") + "}"},
        {"safetensors.trailing", "{\"a\":" + entry("U8", "[3]", "[0,3]") + "}"},
        {"safetensors.checksum", "{\"__metadata__\":{\"crc32.tensors\":\"9be3e0a3\"}," + a + "}"},
        {"safetensors.checksum", "{\"__metadata__\":{\"crc32.header\":\"00000000\"}," + a + "}"},
    };
    for (const auto& [id, header] : cases) CHECK_FAILS(id, parse(raw_file(header, "1234")));
    CHECK_FAILS("safetensors.header_length", parse("\xff\xff\xff\xff\xff\xff\xff\x7f{}"));
    CHECK_FAILS("safetensors.truncated", parse(std::string("\x10\0\0\0\0\0\0\0{}", 10)));
}

TEST(file_is_written_whole_or_not_at_all) {
    const Folder folder;
    const std::string path = folder / "model.safetensors";
    write_safetensors(path, small_file());
    CHECK(read_file(path) == serialise_safetensors(small_file()));
    CHECK_EQUAL(read_safetensors(path).path, path);
    write_file_atomic(path, "old");

    // A full disk: files may have 4096 bytes. In a child, since a limit once lowered may not be raised again.
    const pid_t child = ::fork();
    if (child == 0) {
        std::signal(SIGXFSZ, SIG_IGN);
        const rlimit limit{4096, 4096};
        ::setrlimit(RLIMIT_FSIZE, &limit);
        try {
            write_file_atomic(path, std::string(10000, 'x'));
        } catch (const Error& error) {
            ::_exit(error.id == "file.write" && error.what() == path + ": cannot write it: File too large" ? 7 : 1);
        }
        ::_exit(0);
    }
    int status = 0;
    CHECK(::waitpid(child, &status, 0) == child && WIFEXITED(status) && WEXITSTATUS(status) == 7);
    CHECK_EQUAL(read_file(path), "old");
    CHECK(folder.names() == std::set<std::string>{"model.safetensors"});

    CHECK_FAILS("file.write", write_file_atomic(folder / "missing/file", "x"));
    CHECK_FAILS("file.write", AtomicFile file(folder / "taken");
                std::filesystem::create_directories(folder / "taken");  // so rename() fails, at the last moment
                file.commit());
    CHECK(folder.names() == (std::set<std::string>{"model.safetensors", "taken"}));
}

TEST(an_allocation_that_fails_is_reported_and_leaves_nothing_out) {
    std::string text;
    const auto word = std::string(100, 'x');
    const int in_text = fail_each_allocation([&] { text = text_of(word, 12, word); }, [] { return true; });
    CHECK(in_text > 1 && text == word + "12" + word);

    const Folder folder;
    const std::string path = folder / "file", expected = serialise_safetensors(small_file());
    const auto whole = [&] { return folder.names().empty() || read_file(path) == expected; };
    CHECK(fail_each_allocation([&] { write_safetensors(path, small_file()); }, whole) > 50);
    CHECK(folder.names() == std::set<std::string>{"file"});

    const auto lay_down = [&] {
        for (const char* name : {"/a-name-that-takes-memory.1.tmp", "/another-such-name.2.tmp"})
            write_file_atomic(folder.path.string() + name, "");
        return true;
    };
    lay_down();
    CHECK(fail_each_allocation([&] { remove_temporaries(folder.path); }, lay_down) > 5);
    remove_temporaries(folder.path);
    CHECK(folder.names() == std::set<std::string>{"file"});

    CHECK(fail_each_allocation([] { Threads threads(4); }, [] { return true; }) > 3);
}

TEST(writing_follows_links_and_leaves_what_is_no_regular_file) {
    namespace fs = std::filesystem;
    const Folder folder;
    fs::create_directories(folder / "elsewhere");
    write_file_atomic(folder / "elsewhere/there", "old");
    fs::create_symlink("elsewhere/there", folder / "link");
    fs::create_symlink("link", folder / "link_of_link");
    fs::create_symlink(folder / "elsewhere/new", folder / "dangling");
    write_file_atomic(folder / "link_of_link", "through two links");
    write_file_atomic(folder / "dangling", "where nothing was");
    CHECK_EQUAL(read_file(folder / "elsewhere/there"), "through two links");
    CHECK_EQUAL(read_file(folder / "elsewhere/new"), "where nothing was");
    fs::create_symlink("circle", folder / "circle");
    CHECK_FAILS("file.write", write_file_atomic(folder / "circle", "x"));
    CHECK_EQUAL(::mkfifo((folder / "pipe").c_str(), 0600), 0);
    fs::create_symlink("pipe", folder / "to_pipe");
    for (const char* name : {"pipe", "to_pipe", "elsewhere"})
        CHECK_FAILS("file.not_regular", write_file_atomic(folder / name, "x"));
    for (const char* name : {"link", "link_of_link", "dangling", "circle", "to_pipe"})
        CHECK(fs::is_symlink(folder / name));
    CHECK(fs::is_fifo(folder / "pipe"));
    CHECK_EQUAL(folder.names().size(), size_t{9});

    require_other_file(folder / "another", folder / "link");
    require_other_file(folder / "another", "");
    for (const char* out : {"link", "elsewhere/there", "elsewhere/../elsewhere/there"})
        for (const char* input : {"link_of_link", "elsewhere/there"})
            CHECK_FAILS("file.input", require_other_file(folder / out, folder / input));
    CHECK_FAILS("file.not_regular", require_other_file(folder / "pipe", folder / "link"));
}

TEST(of_two_writers_of_one_file_the_last_to_finish_wins) {
    const Folder folder;
    const std::string path = folder / "file", pid = std::to_string(::getpid());
    {
        AtomicFile first(path);
        AtomicFile second(path), third(path);
        CHECK_EQUAL(first.temporary, path + "." + pid + ".tmp");
        first.write("first, ");
        second.write("second, ");
        third.write("third");
        first.write("whole");
        second.write("whole");
        second.commit();
        CHECK_EQUAL(read_file(path), "second, whole");
        first.commit();
        CHECK_EQUAL(read_file(path), "first, whole");
    }
    CHECK(folder.names() == std::set<std::string>{"file"});

    for (const char* name : {"file.123.tmp", "file.tmp", "123.tmp", "notes.v1.tmp", "x.y.7.tmp"})
        AppendFile(folder / name).write("x");
    remove_temporaries(folder.path);  // what a killed process left, and no other file
    CHECK(folder.names() == (std::set<std::string>{"file", "file.tmp", "123.tmp", "notes.v1.tmp"}));
    remove_temporaries(folder / "missing");
}

TEST(file_reader_refuses_what_is_no_regular_file) {
    const Folder folder;
    CHECK_FAILS("file.open", read_file(folder / "missing"));
    CHECK_FAILS("file.not_regular", read_file(folder.path.string()));
    CHECK_FAILS("file.not_regular", read_file("/dev/zero"));
    write_file_atomic(folder / "nine", "123456789");
    CHECK_EQUAL(read_file(folder / "nine", 9), "123456789");
    CHECK_FAILS("file.too_large", read_file(folder / "nine", 8));
}

TEST(log_continues_from_the_size_that_the_checkpoint_noted) {
    const Folder folder;
    const std::string path = folder / "progress.csv";
    size_t noted = 0;
    {
        const AppendFile log(path);
        log.write("step,return\n");
        log.sync();
        noted = log.size();
        log.write("1000,5\n");
    }
    CHECK_EQUAL(read_file(path), "step,return\n1000,5\n");
    truncate_file(path, noted);
    AppendFile(path).write("1000,6\n");
    CHECK_EQUAL(read_file(path), "step,return\n1000,6\n");
    CHECK_FAILS("file.shorter", truncate_file(path, 1000));
    CHECK_FAILS("file.open", truncate_file(folder / "missing", 0));
    CHECK_FAILS("file.open", AppendFile(folder / "missing/log"));
}

// ---------------------------------------------------------------------------------------------------------------------

namespace {

// Every tag closed in order, every attribute quoted, no stray & or <: enough to tell well-formed XML from a mistake.
bool well_formed(std::string_view xml) {
    std::vector<std::string> open;
    for (size_t i = 0; i < xml.size(); ++i) {
        if (xml[i] == '&') {
            const std::string_view rest = xml.substr(i);
            bool entity = false;
            for (const char* name : {"&amp;", "&lt;", "&gt;", "&quot;"}) entity = entity || rest.starts_with(name);
            if (!entity) return false;
        }
        if (xml[i] != '<') continue;
        const size_t end = xml.find('>', i);
        if (end == std::string_view::npos) return false;
        const std::string_view tag = xml.substr(i + 1, end - i - 1);
        i = end;
        const std::string name(tag.substr(0, tag.find_first_of(" \n")));
        if (tag.find('<') != std::string_view::npos || std::count(tag.begin(), tag.end(), '"') % 2 != 0) return false;
        if (tag[0] == '/') {
            if (open.empty() || "/" + open.back() != name) return false;
            open.pop_back();
        } else if (tag[0] != '!' && tag.back() != '/') {
            open.push_back(name);
        }
    }
    return open.empty();
}

// Besides well-formed: nothing that is not a number where a number belongs, nothing fetched from elsewhere.
void check_figure(const std::string& svg) {
    CHECK(well_formed(svg));
    for (const char* bad : {"nan", "inf", "e+", "href", "<script", "url("}) CHECK(svg.find(bad) == std::string::npos);
}

size_t count(const std::string& text, const std::string& part) {
    size_t found = 0;
    for (size_t at = text.find(part); at != std::string::npos; at = text.find(part, at + 1)) ++found;
    return found;
}

constexpr double not_measured = NAN;

}  // namespace

TEST(ticks_are_round_and_cover_the_data) {
    const auto labels = [](const svg::Axis& axis) {
        std::string out;
        for (const svg::Tick& tick : axis.ticks) out += tick.label + " ";
        return out;
    };
    CHECK_EQUAL(labels(svg::linear_axis(3, 47, 5, 0, 1)), "0 10 20 30 40 50 ");
    CHECK_EQUAL(labels(svg::linear_axis(-0.25, 0.25, 5, 0, 1)), "\u22120.3 \u22120.2 \u22120.1 0.0 0.1 0.2 0.3 ");
    CHECK_EQUAL(labels(svg::linear_axis(0, 20000, 5, 0, 1)), "0 5,000 10,000 15,000 20,000 ");
    CHECK_EQUAL(labels(svg::linear_axis(0, 1, 5, 0, 1)), "0.0 0.2 0.4 0.6 0.8 1.0 ");
    CHECK_EQUAL(labels(svg::linear_axis(94, 97, 5, 0, 1)), "94.0 94.5 95.0 95.5 96.0 96.5 97.0 ");
    // Hostile ranges: nothing, zero, denormal, one value, two that differ in the last bit.
    for (const auto& [low, high] :
         {std::pair(1.0, 0.0), {0.0, 0.0}, {1e-310, 1e-310}, {-3.0, -3.0}, {1e15, 1e15 + 0.125}, {-2e15, 2e15}}) {
        const svg::Axis axis = svg::linear_axis(low, high, 5, 0, 1);
        CHECK(axis.ticks.size() >= 2 && axis.ticks.size() <= 14 &&
              (low > high || (axis.low <= low && axis.high >= high)));
    }
    const Random random{test_seed(), 9};
    for (uint32_t i = 0; i < 2000; ++i) {
        const double scale = std::pow(10.0, 20 * random.uniform(i, 0) - 10);
        const double x = scale * (random.uniform(i, 1) - 0.5), y = x + scale * (i % 3 == 0 ? 0 : random.uniform(i, 2));
        const svg::Axis axis = svg::linear_axis(x, y, 5, 0, 1);
        const double slack = 1e-9 * (axis.high - axis.low);
        CHECK(axis.ticks.size() >= 2 && axis.ticks.size() <= 14);
        CHECK(axis.low <= x + slack && axis.high >= y - slack);
    }
}

TEST(numbers_and_text_are_written_for_xml_and_readers) {
    CHECK_EQUAL(svg::number(-0.001), "0");
    CHECK_EQUAL(svg::number(12.5), "12.5");
    CHECK_EQUAL(svg::number(100), "100");
    CHECK_EQUAL(svg::grouped(1234567.891, 2), "1,234,567.89");
    CHECK_EQUAL(svg::grouped(-999, 0), "\u2212999");
    CHECK_EQUAL(svg::grouped(-0.001, 2), "0.00");
    CHECK_EQUAL(svg::grouped(not_measured, 2), "-");
    CHECK_EQUAL(svg::escaped("<a b=\"c\"> & \x01\u00e9"), "&lt;a b=&quot;c&quot;&gt; &amp; \\x01\u00e9");
    CHECK_EQUAL(svg::visible("a\n\u00e9"), "a\\x0a\u00e9");
    CHECK_EQUAL(svg::visible("a\xff|\n", "<", ">"), "a<\\xff>|<\\x0a>");
    CHECK(!well_formed("<a>") && !well_formed("<a></b>") && !well_formed("a & b") && !well_formed("<a b=\"/>"));
}

// Against a search through all pieces of all lines. A line may have several points at one x: the last counts.
TEST(the_mean_of_lines_is_drawn_where_all_of_them_go) {
    const Random random{test_seed(), 11};
    for (uint32_t trial = 0; trial < 300; ++trial) {
        std::vector<svg::Line> lines(1 + trial % 4);
        double first = 0, last = INFINITY;
        for (uint32_t k = 0; k < lines.size(); ++k) {
            double x = std::floor(4 * random.uniform(trial, 100 * k));
            for (uint32_t i = 0; i < 1 + trial % 7; ++i) {
                lines[k].push_back({x, random.uniform(trial, 100 * k + 2 * i + 1)});
                x += std::floor(3 * random.uniform(trial, 100 * k + 2 * i + 2));
            }
            first = std::max(first, lines[k].front().x);
            last = std::min(last, lines[k].back().x);
        }
        const auto mean_at = [&](double x) {
            double sum = 0;
            for (const svg::Line& line : lines) {
                double height = NAN;
                for (size_t i = 0; i + 1 < line.size(); ++i) {
                    const double share = (x - line[i].x) / (line[i + 1].x - line[i].x);
                    if (share >= 0 && share <= 1) height = (1 - share) * line[i].y + share * line[i + 1].y;
                }
                for (const svg::Point& p : line)
                    if (p.x == x) height = p.y;
                sum += height;
            }
            return sum / static_cast<double>(lines.size());
        };
        const svg::Line mean = svg::mean_of(lines);
        std::set<double> expected, found;
        for (const svg::Line& line : lines)
            for (const svg::Point& p : line)
                if (p.x >= first && p.x <= last) expected.insert(p.x);
        for (const svg::Point& p : mean) {
            found.insert(p.x);
            CHECK_CLOSE(p.y, mean_at(p.x), 1e-12);
        }
        CHECK(found == expected && mean.size() == expected.size());
    }
    CHECK(svg::mean_of({}).empty() && svg::mean_of({{{0, 1}}, {{1, 1}}}).empty());
}

TEST(line_chart_leaves_out_what_is_no_number) {
    const double no = not_measured;
    svg::Chart chart{"R & D <1>", "", "steps", "length", {}, {}, {{"best: 5", svg::black, 5}}};
    chart.series.push_back({"a", svg::blue, {{{0, 9}, {1, no}, {2, 7}, {1e300, 7}}, {{0, 8}, {2, 8}}, {{1, no}}, {}}});
    chart.series.push_back({"b", svg::green, {{{0, 9}, {1, 1e300}}}});
    chart.series.push_back({"none", svg::purple, {{{0, no}}, {}}});
    const std::string svg = svg::draw_chart(chart);
    check_figure(svg);
    CHECK_EQUAL(count(svg, "stroke-opacity"), size_t{2});        // a's lines; b has one, which is its mean
    CHECK_EQUAL(count(svg, "h 0 "), size_t{5});                  // dots
    CHECK_EQUAL(count(svg, "stroke-width=\"2.5\""), size_t{4});  // means, and in the legend
    CHECK_EQUAL(count(svg, ">a<") + count(svg, ">b<"), size_t{2});
    CHECK_EQUAL(count(svg, ">none<") + count(svg, svg::purple), size_t{0});
    CHECK_EQUAL(count(svg, "Z\" fill=\"#000000\""), size_t{2});  // the mark, and the legend's
    CHECK_EQUAL(count(svg, "R &amp; D &lt;1&gt;"), size_t{2});
    CHECK_EQUAL(svg::draw_chart(chart), svg);
    check_figure(svg::draw_chart({"nothing yet", "", "x", "y"}));
    for (const double value : {0.0, no, 1e300, -1e300, 9e14}) {
        chart.series = {{"a", svg::blue, {{{0, value}, {1, value}}, {{0, -value}, {2, value}}}}};
        chart.marks[0].value = value;
        chart.covers = {value};
        check_figure(svg::draw_chart(chart));
        chart.series[0].level = true;
        check_figure(svg::draw_chart(chart));
    }
    chart.series = {{"a", svg::blue, {{}}}};
    for (int i = 0; i < 121; ++i) chart.series[0].lines[0].push_back({static_cast<double>(i), 1});
    CHECK_EQUAL(count(svg::draw_chart(chart), "h 0 "), size_t{0});  // too many to be told apart
    chart.series[0].lines[0].resize(20);
    CHECK_EQUAL(count(svg::draw_chart(chart), "h 0 "), size_t{20});
    chart.series.push_back({"b", svg::green, {{{0, 2}, {190, 2}}}});  // now they lie close together
    CHECK_EQUAL(count(svg::draw_chart(chart), "h 0 "), size_t{2});
}

TEST(outliers_are_drawn_at_the_edge_of_the_frame_and_told) {
    svg::Chart chart{"t", "s", "x", "y", {}, {{"a", svg::blue, {{}}}}};
    for (int i = 0; i < 10; ++i)
        chart.series[0].lines[0].push_back({static_cast<double>(i), i == 0 ? 617.4 : 10.0 - i});
    CHECK_EQUAL(count(svg::draw_chart(chart), ">700<"), size_t{1});  // the axis
    chart.cuts_outliers = true;
    const std::string svg = svg::draw_chart(chart);
    check_figure(svg);
    CHECK_EQUAL(count(svg, ">s; beyond the frame: up to 617<"), size_t{1});
    CHECK_EQUAL(count(svg, "\"M 65.86 50 134.1 80 "), size_t{1});  // on an axis of 0 to 10
    // Another series is no outlier, however far it lies; nor is anything where most values are the same.
    chart.series.push_back({"b", svg::green, {{{0, 900}, {9, 901}}}});
    CHECK_EQUAL(count(svg::draw_chart(chart), ">1,000<"), size_t{1});
    chart.series = {{"a", svg::blue, {{{0, -5}, {1, 1}, {2, 1}, {3, 1}, {4, 1}, {5, 1}}}}};
    CHECK_EQUAL(count(svg::draw_chart(chart), "beyond"), size_t{0});
    chart.series = {{"a", svg::blue, {{{0, -50}, {1, 1}, {2, 1}, {3, 1.5}, {4, 1.5}, {5, 1}}}}};
    CHECK_EQUAL(count(svg::draw_chart(chart), ">s; beyond the frame: from \u221250<"), size_t{1});
}

TEST(line_chart_ends_with_the_data_and_places_points_by_hand) {
    // The y axis is 0..10 on 350..50; its labels are at most two digits wide, so x = 0 lies at 50 + 26 * 0.61.
    svg::Chart chart{"t", "r & s", "x", "y", {}, {{"a", svg::blue, {{{0, 2}, {20700, 10}}, {{0, 4}, {10350, 0}}}}}};
    chart.marks = {{"m", svg::green, 5}};
    chart.series.push_back({"level", svg::green, {{{7, 1}}, {{9, 3}}}, true});
    const std::string svg = svg::draw_chart(chart);
    check_figure(svg);
    CHECK_EQUAL(count(svg, "r &amp; s"), size_t{2});
    CHECK_EQUAL(count(svg, ">20,000<"), size_t{1});
    CHECK_EQUAL(count(svg, ">25,000<"), size_t{0});
    CHECK_EQUAL(count(svg, "d=\"M 65.86 290 680 50 \""), size_t{1});
    CHECK_EQUAL(count(svg, "d=\"M 65.86 290 h 0 M 680 50 h 0 \""), size_t{1});
    CHECK_EQUAL(count(svg, "d=\"M 65.86 230 372.93 350 \""), size_t{1});
    CHECK_EQUAL(count(svg, "d=\"M 65.86 260 372.93 260 \""),
                size_t{1});                          // means 3 and 3, to where the second line ends
    for (const char* level : {"320", "260", "290"})  // heights 1 and 3, and their mean
        CHECK_EQUAL(count(svg, std::string("d=\"M 65.86 ") + level + " 680 " + level + " \""), size_t{1});
    CHECK_EQUAL(count(svg, "stroke-dasharray"), size_t{4});                           // those, and the legend's
    CHECK_EQUAL(count(svg, "d=\"M 683 200 688 193 693 200 688 207 Z\""), size_t{1});  // the mark beside the plot
    chart.covers = {50};
    CHECK_EQUAL(count(svg::draw_chart(chart), "d=\"M 65.86 338 680 290 \""), size_t{1});  // on an axis of 0..50
}

TEST(bar_chart_draws_one_bar_per_number) {
    svg::Chart chart{"t", "", "x", "y", {"R", "D", "R-D"}};
    chart.series = {{"a", svg::blue, {{{0, 1}, {1, not_measured}, {2, 68}}, {{0, 1}, {1, not_measured}, {2, 72}}}}};
    chart.series.push_back({"none", svg::green, {{}, {{0, not_measured}}}});
    const std::string svg = svg::draw_chart(chart);
    check_figure(svg);
    CHECK_EQUAL(count(svg, "<rect"), size_t{4});               // background, two bars, legend
    CHECK_EQUAL(count(svg, "stroke=\"#222222\""), size_t{1});  // the stroke of the bar whose values differ
    CHECK_EQUAL(count(svg, "y=\"87.5\""), size_t{1});          // 70 of 80 on 350..50
    CHECK_EQUAL(count(svg, "height=\"262.5\""), size_t{1});
    CHECK_EQUAL(count(svg, "y1=\"80\"") + count(svg, "y2=\"95\""), size_t{2});  // 72 and 68
    for (const char* label : {">R<", ">D<", ">R-D<"}) CHECK_EQUAL(count(svg, label), size_t{1});
}

TEST(legend_begins_a_new_row_before_the_edge) {
    const std::vector<svg::Key> keys(3, {"", "a label"});  // 34 + 13 * 0.61 * 7 = 89.51 wide, and a gap of 18
    const std::string svg = svg::picture(250, 100, "t", "", "", keys);
    CHECK_EQUAL(count(svg, "translate(16 100 )") + count(svg, "translate(123.51 100 )"), size_t{2});
    CHECK_EQUAL(count(svg, "translate(16 124 )"), size_t{1});
    CHECK_EQUAL(count(svg, "viewBox=\"0 0 250 146 \""), size_t{1});
    // A long title is set smaller, 218 / (0.61 * 30), and at 8 makes the figure wider: 32 + 8 * 0.61 * 50.
    const std::string smaller = svg::picture(250, 100, std::string(30, 't'), "", "", keys);
    CHECK_EQUAL(count(smaller, "viewBox=\"0 0 250 146 \""), size_t{1});
    CHECK_EQUAL(count(smaller, "font-size=\"11.91\""), size_t{1});
    CHECK_EQUAL(count(svg::picture(250, 100, std::string(50, 't'), "", "", {}), "viewBox=\"0 0 276 122 \""), size_t{1});
}

TEST(map_draws_one_arrow_per_action_on_filled_cells) {
    svg::CellMap map{"p", 2, 3};
    for (const svg::Place cell : {svg::Place{0, 0}, {0, 1}, {1, 2}}) map.fill_cell(cell, "#B9DAEF");
    map.add_letter({1, 2}, "G", svg::green);
    map.add_arrow({0, 0}, 0, 1, 1);
    map.add_arrow({0, 1}, 1, 1, 0.5);
    map.add_arrow({0, 2}, 1, 0, 0.25);
    map.add_arrow({1, 0}, -1, 0, 0);
    const std::string svg = svg::draw_map(map);  // cells of 200, the first at (48, 76)
    check_figure(svg);
    CHECK_EQUAL(count(svg, "<g opacity"), size_t{4});
    CHECK_EQUAL(count(svg, "#B9DAEF"), size_t{3});
    CHECK_EQUAL(count(svg, "<rect x=\"448\" y=\"276\" width=\"200\" height=\"200\""), size_t{1});
    CHECK_EQUAL(count(svg, "d=\"M 216 176 190 191.6 190 160.4 Z\""), size_t{1});  // R: half a length is 0.34 of 200
    CHECK_EQUAL(count(svg, ">G<"), size_t{1});
}

TEST(map_draws_paths_with_their_ends_and_circles) {
    // Three rows and four columns: cells of 150, the first at (48, 76).
    svg::CellMap map{"m <1>", 3, 4};
    map.keys = {{"", "goal & radius"}};
    map.add_path({{1, 1}, {1, 1.5}, {1, 2}}, svg::blue);
    map.add_path({{2, 1}, {1, 1}}, svg::green);
    map.add_circle({1, 2}, 0.5, svg::ink);
    map.fill_cell({2, 2}, "#C8C8C8");
    const std::string svg = svg::draw_map(map);
    check_figure(svg);
    CHECK_EQUAL(count(svg, "#C8C8C8"), size_t{1});
    CHECK_EQUAL(count(svg, "<rect x=\"348\" y=\"376\""), size_t{1});         // row 2, column 2
    CHECK_EQUAL(count(svg, "d=\"M 273 301 348 301 423 301 \""), size_t{1});  // a row goes from left to right
    CHECK_EQUAL(count(svg, "d=\"M 273 451 273 301 \""), size_t{1});          // upwards from row 2 to row 1
    CHECK_EQUAL(count(svg, "<circle cx=\"423\" cy=\"301\" r=\"75\""), size_t{1});
    CHECK_EQUAL(count(svg, "r=\"5\""), size_t{2});                 // starts
    CHECK_EQUAL(count(svg, "stroke-width=\"3\""), size_t{2 * 2});  // ends are crosses
    CHECK_EQUAL(count(svg, "goal &amp; radius"), size_t{1});
    CHECK_EQUAL(svg::draw_map(map), svg);
    // Layers, whatever the order of the calls: cells, lines between them, circles, paths, ends.
    const size_t cell = svg.find("#C8C8C8"), lines = svg.find("#B0B0B0"), circle = svg.find("r=\"75\"");
    CHECK(cell < lines && svg.rfind("#B0B0B0") < circle && circle < svg.find("stroke-opacity"));
    CHECK(svg.rfind("stroke-opacity") < svg.find("r=\"5\""));
    map.add_path({{-1e12, 1}, {1, 1}, {1e12, 9}}, svg::blue);  // far off: on the edge
    CHECK_EQUAL(count(svg::draw_map(map), "d=\"M 273 76 273 301 648 526 \""), size_t{1});
}

TEST(pages_are_one_well_formed_file_and_aligned_markdown) {
    const Table table{{"method", "a|b"}, {{"<ODT>", "7"}, {"\u00b1", "1,000"}}};
    const Figure figure{svg::draw_chart({"t", "", "x", "y"}), "c", "t.svg"};
    const Files files{"<run>", "../a b#", {"x.csv", "y"}};
    const std::vector<Section> sections{{"h", {"p < q", table, figure, files}, "as in the paper"}};
    const std::string html = html_page("A & B", sections);
    CHECK(html.starts_with("<!DOCTYPE html>"));
    CHECK(well_formed(html));  // the style sheet has no tags, void elements are closed
    CHECK_EQUAL(count(html, "&lt;ODT&gt;"), size_t{1});
    CHECK_EQUAL(count(html, "<h1>A &amp; B</h1>\n<p>as in the paper</p>\n<h2>h</h2>\n<p>p &lt; q</p>"), size_t{1});
    CHECK_EQUAL(count(html, figure.svg), size_t{1});
    CHECK_EQUAL(page(Markdown{}, "A & B", sections),
                "# A & B\n\nas in the paper\n\n## h\n\np < q\n\n"
                "| method |  a\\|b |\n| ------ | ----: |\n| <ODT>  |     7 |\n| \u00b1      | 1,000 |\n\n"
                "![](t.svg)\n\nc\n\n<run>: [x.csv](../a%20b%23/x.csv) [y](../a%20b%23/y)\n\n");
    CHECK_EQUAL(count(html, "&lt;run&gt;: <a href=\"../a%20b%23/x.csv\">x.csv</a> <a href="), size_t{1});
    CHECK_EQUAL(url_of("50%<\"(&)\">?"), "50%25%3C%22%28%26%29%22%3E%3F");
    CHECK_EQUAL(url_of("\\\n\xff\u00e9"), "%5C%0A%FF%C3%A9");
}
