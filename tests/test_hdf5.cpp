// test_hdf5.cpp: data/hdf5.hpp against files that h5py made (tests/hdf5/make.py), published checksums, streams made by
// zlib, files of its own, and damage of every kind.
#include <sys/resource.h>
#include <sys/wait.h>

#include <chrono>
#include <csignal>
#include <filesystem>
#include <fstream>

#include "hdf5_files.hpp"
#include "test.hpp"

namespace {

struct Folder {
    std::filesystem::path path = std::filesystem::temp_directory_path() / ("wodtem_hdf5_" + std::to_string(::getpid()));
    Folder() { std::filesystem::create_directories(path); }
    ~Folder() { std::filesystem::remove_all(path); }
    std::string operator/(const std::string& name) const { return (path / name).string(); }
};

Hdf5File parse(const std::string& bytes) { return parse_hdf5(bytes, "test"); }

// One string of fixed length, without the NULs or spaces that fill it up.
std::string read_text(const Hdf5File& file, const Hdf5Dataset& dataset) {
    CHECK(dataset.unsupported.empty() && dataset.element.kind == Hdf5Element::text && dataset.elements == 1);
    std::vector<uint8_t> buffer;
    const Bytes found = dataset.chunks.empty() ? dataset.fill : file.decode(dataset, dataset.chunks.at(0), buffer);
    std::string text(found.begin(), std::ranges::find(found, 0));
    text.resize(text.find_last_not_of(' ') + 1);
    return text;
}

// What make.py stores as element i.
double formula(const std::string& type, size_t i) {
    const double v = static_cast<double>(37 * i % 251);
    if (type.starts_with("float")) return v / 128;
    if (type.starts_with("bool")) return 37 * i % 251 % 2 == 1 ? 1 : 0;
    return type.starts_with("int") ? v - 125 : v;
}

double stored(const std::string& path, const std::string& type, size_t i) {
    if (path == "types/scalar") return -125.0 / 128;
    if (path == "types/enumeration") return i == 0 ? 7 : i == 1 ? 0 : 1;
    if (path == "chunks/holes") return i / 6 / 2 == 1 && i % 6 / 2 == 1 ? 7 : -2.5;
    if (path == "chunks/holes_gzip") return i == 4 ? 1 : 9;
    if (path == "chunks/nothing" || path == "strange/half" || path == "lzf/zeros") return 0;
    if (path == "chunks/unwritten") return 0.5;
    if (path == "chunks/grown" && i >= 20) return 0;
    if (path == "sparse_pages") return i == 0 || i == 4096 || i == 5119 || i == 8999 ? 200 : 3;
    if (path == "sparse_rows") {
        constexpr size_t set[] = {0, 131059, 131060, 132083, 132084, 133108, 135000, 139999};
        return std::ranges::find(set, i) != std::end(set) ? 200 : 3;
    }
    return formula(type, i);
}

void check_contents(const std::string& name, const Hdf5File& file, size_t expected_count) {
    CHECK_EQUAL(file.datasets.size(), expected_count);
    for (const Hdf5Dataset& dataset : file.datasets) {
        if (!dataset.unsupported.empty() || dataset.element.kind == Hdf5Element::text) continue;
        const std::vector<double> values = file.read<double>(dataset);
        const std::vector<float> floats = file.read<float>(dataset);
        size_t wrong = values.size() == dataset.elements && floats.size() == dataset.elements ? 0 : 1;
        for (size_t i = 0; i < values.size(); ++i) {
            const double expected = stored(dataset.path, dataset.type, i);
            wrong += values[i] == expected && floats[i] == static_cast<float>(expected) ? 0 : 1;
        }
        if (wrong > 0) report_failure(__FILE__, __LINE__, name + ": " + dataset.path + ": wrong values");
    }
}

// Reads all there is; an Error is as good an end as a value.
bool survives(const std::string& bytes) {
    try {
        const Hdf5File file = parse(bytes);
        for (const Hdf5Dataset& dataset : file.datasets) {
            try {
                std::vector<uint8_t> buffer;
                for (const Hdf5Chunk& chunk : dataset.chunks)
                    if (dataset.unsupported.empty()) file.decode(dataset, chunk, buffer);
                if (dataset.element.kind != Hdf5Element::text && file.read<float>(dataset).size() != dataset.elements)
                    return false;
            } catch (const Error& error) {
                if (!error.id.starts_with("hdf5.")) return false;
            }
        }
        for (const std::string& name : file.names()) file.find(name);
        return true;
    } catch (const Error& error) {
        return error.id.starts_with("hdf5.");
    }
}

uint64_t u64(const std::string& bytes, size_t at) { return little_endian(as_bytes(bytes).subspan(at, 8)); }
void set_u64(std::string& bytes, size_t at, uint64_t value) { std::memcpy(bytes.data() + at, &value, 8); }

// Where a structure [begin, end) is followed by its checksum: at each signature every length is tried.
std::vector<std::pair<size_t, size_t>> checksummed(const std::string& bytes) {
    std::vector<std::pair<size_t, size_t>> found;
    constexpr const char* signatures[] = {"\x89HDF", "OHDR", "OCHK", "BTHD", "BTLF", "BTIN", "FRHP",
                                          "FHIB",    "FAHD", "FADB", "EAHD", "EAIB", "EADB", "EASB"};
    for (const char* signature : signatures)
        for (size_t at = bytes.find(signature); at != std::string::npos; at = bytes.find(signature, at + 1))
            for (size_t end = at + 8; end + 4 <= bytes.size() && end < at + 700; ++end)
                if (lookup3(as_bytes(bytes).subspan(at, end - at)) == little_endian(as_bytes(bytes).subspan(end, 4))) {
                    found.emplace_back(at, end);
                    break;
                }
    return found;
}

void seal(std::string& bytes, const std::vector<std::pair<size_t, size_t>>& structures) {
    for (const auto& [begin, end] : structures) {
        const uint32_t sum = lookup3(as_bytes(bytes).subspan(begin, end - begin));
        std::memcpy(bytes.data() + end, &sum, 4);
    }
}

std::string unhex(const std::string& digits) {
    std::string bytes;
    for (size_t i = 0; i < digits.size(); i += 2)
        bytes += static_cast<char>(std::stoi(digits.substr(i, 2), nullptr, 16));
    return bytes;
}

// What is wrong with a stream; empty if it gives the expected bytes.
std::string complaint(const std::string& stream, const std::string& expected) {
    try {
        return std::ranges::equal(inflate_zlib(as_bytes(stream), expected.size()), as_bytes(expected)) ? ""
                                                                                                       : "other bytes";
    } catch (const Error& error) {
        CHECK_EQUAL(error.id, "hdf5.deflate");
        return error.what();
    }
}
bool inflates_to(const std::string& stream, const std::string& expected) { return complaint(stream, expected).empty(); }

}  // namespace

TEST(sha256_gives_the_digests_of_the_standard) {  // FIPS 180-2, appendix B, and the empty message
    CHECK_EQUAL(sha256(as_bytes("")), "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855");
    CHECK_EQUAL(sha256(as_bytes("abc")), "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
    CHECK_EQUAL(sha256(as_bytes("abcdbcdecdefdefgefghfghighijhijkijkljklmklmnlmnomnopnopq")),
                "248d6a61d20638b8e5c026930c3e6039a33ce45964ff2167f6ecedd419db06c1");
    CHECK_EQUAL(sha256(as_bytes(std::string(1000000, 'a'))),
                "cdc76e5c9914fb9281a1c7e284d73e67f1809a48a497200e046d39ccc7112cd0");
    const Folder folder;
    write_file_atomic(folder / "f", "abc");
    CHECK_EQUAL(sha256_of_file(folder / "f"), sha256(as_bytes("abc")));
    write_file_atomic(folder / "f", "");
    CHECK_EQUAL(sha256_of_file(folder / "f"), sha256(as_bytes("")));
    CHECK_FAILS("file.open", sha256_of_file(folder / "missing"));
}

TEST(hdf5_checksums_give_published_values) {
    CHECK_EQUAL(adler32(as_bytes("Wikipedia")), 0x11E60398u);
    CHECK_EQUAL(adler32(as_bytes(std::string(1000000, '\xFF'))), 0x3843E1BEu);  // zlib.adler32
    CHECK_EQUAL(lookup3(as_bytes("")), 0xDEADBEEFu);                            // lookup3.c, driver5
    CHECK_EQUAL(lookup3(as_bytes("Four score and seven years ago")), 0x17770551u);
    CHECK_EQUAL(fletcher32(as_bytes("\1\2\3\4")), 0x05080406u);  // words 0102 and 0304
    CHECK_EQUAL(fletcher32(as_bytes("\1\2\3")), 0x05040402u);
    CHECK_EQUAL(fletcher32(as_bytes("\xFF\xFF")), 0xFFFFFFFFu);
    CHECK_EQUAL(fletcher32({}), 0u);
    std::string ones(1 << 18, '\xFF');
    CHECK_EQUAL(fletcher32(as_bytes(ones)), 0xFFFFFFFFu);
}

TEST(inflate_reads_all_three_kinds_of_blocks) {  // streams of Python's zlib
    std::string period, squares;
    for (int i = 0; i < 80; ++i) period += static_cast<char>(37 * (i % 40) % 251);
    for (int i = 0; i < 400; ++i) squares += static_cast<char>(i * i / 7 % 11);
    const std::string kept = unhex("7801015000afff") + period + unhex("bf4d2539");  // level 0
    const std::string fixed = unhex(
        "78016350f5ca9fb2f31e876e50f99c83cf044ca3ea979c7c27619bd4bee6e23705d7acfe2d3799357c8ba6ef6120521d00bf4d2539");
    const std::string dynamic = unhex(
        "78daedccc10dc040080341630b0ed37fc121523ac8f7f63d5a0041e53154668d9a872d6774724e2a30eecd835837cc8ef4c7a6e812bc8e81"
        "b73bfb377b00eec40784");
    CHECK(inflates_to(kept, period));
    CHECK(inflates_to(fixed, period));
    CHECK(inflates_to(dynamic, squares));
    CHECK(inflates_to(unhex("789c030000000001"), ""));
    const std::string skewed = hdf5_bytes("skewed");  // codes of up to 15 bits
    std::string expected, mixed;
    for (size_t k = 0, a = 1, b = 1; k < 17; ++k, std::swap(a, b), b += a)
        expected += std::string(a, static_cast<char>(k));
    for (size_t i = 0; i < 4180; ++i) mixed += expected[i * 2531 % 4180];
    CHECK(skewed == mixed);

    for (const auto& [stream, text] : {std::pair(kept, period), {fixed, period}, {dynamic, squares}}) {
        for (size_t cut = 0; cut < stream.size(); ++cut) CHECK(!inflates_to(stream.substr(0, cut), text));
        CHECK(!inflates_to(stream + "x", text));
        CHECK(!inflates_to(stream, text + "x"));
        CHECK(!inflates_to(stream, text.substr(1)));
        for (size_t bit = 0; bit < 8 * stream.size(); ++bit) {  // no damage of one bit goes unnoticed
            std::string damaged = stream;
            damaged[bit / 8] = static_cast<char>(damaged[bit / 8] ^ 1 << bit % 8);
            // What may change: the level in the header, a hint; bits to fill up a byte.
            const bool filling = stream == kept ? bit >= 19 && bit < 24 : bit >= 8 * (stream.size() - 5);
            CHECK(!inflates_to(damaged, text) || bit / 8 == 1 || filling);
        }
    }
}

TEST(inflate_refuses_invalid_streams) {
    const auto wrong = [](const std::string& hex, size_t size) {
        return complaint(unhex(hex), std::string(size, 'a'));
    };
    CHECK_EQUAL(wrong("7802030000000001", 0), "no zlib header");
    CHECK_EQUAL(wrong("78bb030000000001", 0), "no zlib header");  // with a dictionary
    CHECK_EQUAL(wrong("789c070000000001", 0), "a block of type 3");
    CHECK_EQUAL(wrong("789c010100000061616161", 1), "a stored block whose length does not match its complement");
    CHECK_EQUAL(wrong("789c030200ffffffff", 9), "a distance to before the start");
    CHECK_EQUAL(wrong("789c030000000002", 0), "data that does not match its Adler-32 checksum");
    CHECK_EQUAL(wrong("789c03000000000001", 0), "bytes after the end of the compressed data");
    CHECK_EQUAL(wrong("789cfdff0000000000000000000000000000", 9), "too many codes");
    CHECK_EQUAL(wrong("789c05c000000000000000000000000000", 9), "a code that stands for nothing");
    CHECK_EQUAL(wrong("789c05e0ffff0f00000000000000000000", 9), "an invalid code of code lengths");
}

TEST(hdf5_files_made_by_h5py_are_read) {
    using enum Hdf5Filter;
    for (const char* name : {"old", "latest", "latest-1.12"}) {
        const Hdf5File file = parse(hdf5_bytes(name));
        check_contents(name, file, std::string(name) == "latest-1.12" ? 62 : 63);
        const auto type = [&](const char* path) { return file.find(path) == nullptr ? "none" : file.find(path)->type; };
        CHECK_EQUAL(type("types/float32"), "float32");
        CHECK_EQUAL(type("types/float64_big"), "float64, big-endian");
        CHECK_EQUAL(type("types/int8"), "int8");
        CHECK_EQUAL(type("types/uint64_big"), "uint64, big-endian");
        CHECK_EQUAL(type("types/bool"), "bool");
        CHECK_EQUAL(type("types/enumeration"), "enumeration uint16");
        CHECK_EQUAL(type("text/scalar"), "text of 13 bytes");
        CHECK_EQUAL(type("strange/soft"), "float32");
        CHECK_FAILS("hdf5.link", file.find("strange/external"));
        CHECK_EQUAL(type("strange/named"), "none");
        CHECK(file.find("types/scalar")->shape.empty());
        CHECK(file.find("types/none")->shape == (Shape{0, 4}));
        CHECK(file.find("types/null")->shape == Shape{0});
        CHECK(file.find("chunks/fixed_gzip")->shape == (Shape{7, 9, 2}));
        CHECK(file.find("filters/sdf")->filters == (std::vector{shuffle, deflate, fletcher}));
        CHECK(file.find("filters/fds")->filters == (std::vector{fletcher, deflate, shuffle}));
        CHECK_EQUAL(file.find("types/float32")->stored, size_t{60});
        CHECK_EQUAL(file.find("chunks/holes")->stored, size_t{16});
        CHECK_EQUAL(file.find("chunks/fixed")->stored, size_t{4 * 3 * 2 * 4 * 4});  // whole chunks
        CHECK_EQUAL(read_text(file, *file.find("text/scalar")), "tanh_gaussian");
        for (const char* text : {"nul_ended", "nul_padded", "spaces"})
            CHECK_EQUAL(read_text(file, *file.find("text/" + std::string(text))), "relu");

        for (const char* path : {"compound", "variable", "array", "shared", "reference"}) {
            const Hdf5Dataset* dataset = file.find("strange/" + std::string(path));
            CHECK(dataset != nullptr && !dataset->unsupported.empty());
            if (dataset != nullptr) CHECK_FAILS("hdf5.unsupported", file.read<float>(*dataset));
        }
        CHECK_FAILS("hdf5.type", file.read<float>(*file.find("text/scalar")));
        CHECK_EQUAL(type("text/two"), "text of 2 bytes");
    }
}

TEST(hdf5_soft_links_and_attributes_of_the_root_are_read) {
    for (const char* name : {"root_old", "root_latest"}) {
        const Hdf5File file = parse(hdf5_bytes(name));
        check_contents(name, file, 1);
        CHECK(file.attributes == (std::map<std::string, double>{{"total_episodes", 12}, {"half", 0.5}}));
        CHECK_EQUAL(file.links.size(), size_t{8});
        CHECK_EQUAL(file.names().size(), size_t{9});
        for (const char* path : {"a", "group/b", "group/c", "alias/a", "alias_of_alias/c", "self/self/alias/b"})
            CHECK(file.find(path) == &file.datasets[0]);
        CHECK(file.find("group") == nullptr && file.find("b") == nullptr);
        for (const char* path : {"gone", "circle", "alias/d", "self/gone"}) CHECK_FAILS("hdf5.link", file.find(path));
    }
    try {
        parse(hdf5_bytes("latest")).find("strange/external");
    } catch (const Error& error) {
        CHECK_EQUAL(std::string(error.what()),
                    "test: \"strange/external\": is a link to \"another file: elsewhere.hdf5 /x\", which is no data "
                    "set of this file");
    }
}

// tests/hdf5/make.py, peers(): of half precision the values are written down here again, from the standard.
TEST(hdf5_files_with_lzf_halves_and_hard_links_are_read) {
    for (const char* name : {"peers_old", "peers_latest"}) {
        const Hdf5File file = parse(hdf5_bytes(name));
        for (const auto& [path, filters] :
             {std::pair("lzf/float", 1), {"lzf/shuffled", 3}, {"lzf/zeros", 1}, {"lzf/kept", 1}}) {
            const Hdf5Dataset* dataset = file.find(path);
            CHECK(dataset != nullptr && dataset->unsupported.empty());
            CHECK_EQUAL(std::ranges::count(dataset->filters, Hdf5Filter::lzf), 1);
            CHECK_EQUAL(dataset->filters.size(), static_cast<size_t>(filters));
            const std::vector<double> values = file.read<double>(*dataset);
            size_t wrong = 0;
            for (size_t i = 0; i < values.size(); ++i) wrong += values[i] != stored(path, dataset->type, i);
            CHECK_EQUAL(wrong, size_t{0});
        }
        CHECK(file.find("lzf/float")->stored < 3600 && file.find("lzf/zeros")->stored < 400);
        CHECK_EQUAL(file.find("half/little")->type, "float16");
        CHECK_EQUAL(file.find("half/big")->type, "float16, big-endian");
        const std::array<double, 12> halves = {0,       1,         -2,       0x1.55p-2, 65504, 0x1.ff8p-15,
                                               0x1p-24, 0x1.4p-20, INFINITY, -INFINITY, NAN,   -0.0};
        for (const char* path : {"half/little", "half/big"}) {
            const std::vector<double> values = file.read<double>(*file.find(path));
            const std::vector<float> floats = file.read<float>(*file.find(path));
            for (size_t i = 0; i < halves.size(); ++i) {
                CHECK(values[i] == halves[i] || (std::isnan(values[i]) && std::isnan(halves[i])));
                CHECK(floats[i] == halves[i] || (std::isnan(floats[i]) && std::isnan(halves[i])));
                CHECK_EQUAL(std::signbit(values[i]), std::signbit(halves[i]));
            }
        }
        // Every group is there once, under its shortest path, and all paths lead to it.
        CHECK(file.links == (std::map<std::string, std::string>{
                                {"a/b/c/first", "half"}, {"a/parent", ""}, {"a/b/self", "a/b"}, {"also_a", "a"}}));
        for (const char* path : {"a/b/c/first/big", "also_a/b/c/first/big", "a/parent/a/b/self/self/c/first/big"})
            CHECK(file.find(path) == file.find("half/big"));
        CHECK(file.find("also_a") == nullptr && file.find("a/parent") == nullptr);
        CHECK_FAILS("hdf5.link", file.find("also_a/nothing"));
        CHECK(file.find("line\nbreak") != nullptr);
        size_t deep = 0;
        for (const std::string& path : file.names()) deep += path.ends_with("/deep") && path.size() > 300;
        CHECK_EQUAL(deep, size_t{1});
        CHECK(std::ranges::none_of(file.names(), [](const std::string& path) { return path.size() > 4096; }));
    }
}

TEST(hdf5_data_that_cannot_be_read_are_refused_in_words) {
    const auto said = [](const char* name, const char* path) {
        const Hdf5File file = parse(hdf5_bytes(name));
        try {
            file.read<float>(*file.find(path));
        } catch (const Error& error) {
            CHECK_EQUAL(error.id, "hdf5.unsupported");
            return std::string(error.what());
        }
        return std::string();
    };
    const std::string advice = "; h5repack -f GZIP=4 OLD NEW (of HDF5's tools) writes a file that can be read";
    CHECK_EQUAL(said("peers_latest", "refused/virtual"),
                "test: \"refused/virtual\": cannot be read: its layout is "
                "virtual: the data are in other data sets or files" +
                    advice);
    for (const auto& [path, filter] : {std::pair("scale_offset", "6 (scale-offset)"), {"n_bit", "5 (n-bit)"}})
        CHECK_EQUAL(said("peers_old", ("refused/" + std::string(path)).c_str()),
                    "test: \"refused/" + std::string(path) + "\": cannot be read: filter " + filter +
                        " is not supported" + advice);
    CHECK_EQUAL(said("tables", "blosc"),
                "test: \"blosc\": cannot be read: filter 32001 (Blosc) is not supported" + advice);
    const std::string shared =
        " is shared with other objects (a committed type, or shared messages); write the data "
        "anew, with h5py as create_dataset(NAME, data=OLD[NAME][:])";
    CHECK_EQUAL(said("peers_old", "refused/committed"),
                "test: \"refused/committed\": cannot be read: its type" + shared);
    CHECK_EQUAL(said("shared", "actions"), "test: \"actions\": cannot be read: its shape" + shared);
}

TEST(hdf5_files_of_pytables_hold_flags_in_bit_fields) {
    const Hdf5File file = parse(hdf5_bytes("tables"));
    for (const char* path : {"flags", "zipped"}) {
        CHECK_EQUAL(file.find(path)->type, "bit field of 8");
        const std::vector<uint8_t> flags = file.read_flags(*file.find(path));
        CHECK_EQUAL(flags.size(), size_t{40});
        for (size_t i = 0; i < flags.size(); ++i) CHECK_EQUAL(int{flags[i]}, static_cast<int>(37 * i % 251 % 2));
    }
}

TEST(lzf_streams_are_decompressed_or_refused) {
    const auto complaint_of = [](const std::string& hex, const std::string& expected) -> std::string {
        try {
            const auto out = decompress_lzf(as_bytes(unhex(hex)), expected.size());
            return std::ranges::equal(out, as_bytes(expected)) ? "" : "other bytes";
        } catch (const Error& error) {
            CHECK_EQUAL(error.id, "hdf5.lzf");
            return error.what();
        }
    };
    CHECK_EQUAL(complaint_of("", ""), "");
    CHECK_EQUAL(complaint_of("02616263", "abc"), "");
    CHECK_EQUAL(complaint_of("026162634002", "abcabca"), "");           // 2 + 2 bytes from 2 + 1 back
    CHECK_EQUAL(complaint_of("0061e00000", std::string(10, 'a')), "");  // 7 + 0 + 2 bytes from 1 back
    CHECK_EQUAL(complaint_of("0061e0ff00", std::string(265, 'a')), "");
    std::string all, hex;  // 256 runs of 32 bytes, of which the first comes again, from the farthest distance, 1fff + 1
    for (int i = 0; i < 8192; ++i) all += static_cast<char>(i % 251);
    for (const char c : all) hex += (hex.size() % 66 == 0 ? "1f" : "") + hex8(static_cast<uint8_t>(c)).substr(6);
    CHECK_EQUAL(complaint_of(hex + "ff17ff", all + all.substr(0, 32)), "");
    CHECK_EQUAL(complaint_of("0162613fff", "ba"), "a distance to before the start");
    CHECK_EQUAL(complaint_of("0061", "aa"), "less data than the chunk holds");
    CHECK_EQUAL(complaint_of("016161", "a"), "more data than the chunk holds");
    CHECK_EQUAL(complaint_of("00612000", "aaa"), "more data than the chunk holds");
    for (const char* cut : {"00", "0361", "006120", "0061e0", "0061e000"})
        CHECK_EQUAL(complaint_of(cut, std::string(300, 'a')), "the end of the compressed data");
}

TEST(hdf5_large_indexes_and_groups_are_read) {
    check_contents("old_large", parse(hdf5_bytes("old_large")), 6);
    check_contents("latest_large", parse(hdf5_bytes("latest_large")), 6);
    check_contents("edges", parse(hdf5_bytes("edges")), 2);
    check_contents("many_old", parse(hdf5_bytes("many_old")), 401);
    check_contents("long_names", parse(hdf5_bytes("long_names")), 301);
    const Hdf5File many = parse(hdf5_bytes("many_latest"));
    check_contents("many_latest", many, 5001);
    for (int i = 0; i < 5000; ++i) CHECK(many.find("many/episode_" + std::to_string(i)) != nullptr);
    CHECK(many.find("many/episode_5000") == nullptr);
    CHECK(many.find("many") == nullptr);
}

TEST(hdf5_superblocks_of_every_version_are_read) {
    const std::string base = hdf5_bytes("userblock");
    CHECK_EQUAL(int{base[1024 + 8]}, 0);
    check_contents("userblock", parse(base), 1);
    const int versions[] = {0, 1, 2, 3};
    const char* names[] = {"small_old", "superblock1", "superblock2", "small_latest"};
    for (size_t i = 0; i < 4; ++i) {
        const std::string bytes = hdf5_bytes(names[i]);
        CHECK_EQUAL(int{bytes[8]}, versions[i]);
        check_contents(names[i], parse(bytes), i == 0 || i == 3 ? 9 : 1);
    }
}

TEST(hdf5_files_of_d4rl_are_read) {
    const Hdf5File file = parse(hdf5_bytes("d4rl-1.12"));
    check_contents("d4rl", file, 14);
    CHECK(file.find("observations")->shape == (Shape{700, 11}));
    CHECK(file.find("observations")->filters == std::vector{Hdf5Filter::deflate});
    CHECK_EQUAL(file.find("infos/qpos")->type, "float64");
    CHECK_EQUAL(read_text(file, *file.find("metadata/algorithm")), "SAC");
    CHECK_EQUAL(file.read<double>(*file.find("metadata/iteration"))[0], -125.0);
    const std::vector<uint8_t> flags = file.read_flags(*file.find("terminals"));
    CHECK_EQUAL(flags.size(), size_t{700});
    for (size_t i = 0; i < flags.size(); ++i) CHECK_EQUAL(int{flags[i]}, static_cast<int>(37 * i % 251 % 2));
    CHECK_FAILS("hdf5.flag", file.read_flags(*file.find("rewards")));
}

TEST(hdf5_files_of_minari_are_read) {
    const Hdf5File file = parse(hdf5_bytes("minari"));
    check_contents("minari", file, 72);
    for (size_t e = 0; e < 12; ++e) {
        const Hdf5Dataset* dataset = file.find("episode_" + std::to_string(e) + "/infos/qpos");
        CHECK(dataset != nullptr && dataset->shape == (Shape{21 + e, 3}));
    }
}

TEST(hdf5_damage_that_a_checksum_covers_is_found) {
    const std::string latest = hdf5_bytes("latest");
    const Hdf5File file = parse(latest);
    const auto damaged = [&](uint64_t at) {
        std::string bytes = latest;
        bytes[at] = static_cast<char>(bytes[at] ^ 1);
        return parse(bytes);
    };
    for (const char* path : {"filters/f", "filters/df", "filters/sdf"}) {
        const Hdf5Chunk& chunk = file.find(path)->chunks[3];
        CHECK_FAILS("hdf5.checksum", const Hdf5File f = damaged(chunk.address + 5); f.read<float>(*f.find(path)));
        CHECK_FAILS("hdf5.checksum", const Hdf5File f = damaged(chunk.address + chunk.size - 1);
                    f.read<float>(*f.find(path)));
    }
    const Hdf5Chunk& chunk = file.find("filters/sd")->chunks[0];
    CHECK_FAILS("hdf5.deflate", const Hdf5File f = damaged(chunk.address + chunk.size - 1);
                f.read<float>(*f.find("filters/sd")));
    const std::string small = hdf5_bytes("small_latest");
    const auto structures = checksummed(small);
    CHECK(structures.size() > 15);
    for (const auto& [begin, end] : structures) {
        std::string bytes = small;
        bytes[end + 3] = static_cast<char>(bytes[end + 3] ^ 1);
        CHECK_FAILS("hdf5.checksum", parse(bytes));
    }
    try {
        const Hdf5File f = damaged(chunk.address + chunk.size - 1);
        f.read<float>(*f.find("filters/sd"));
    } catch (const Error& error) {
        CHECK_EQUAL(error.what(),
                    "test: \"filters/sd\": chunk at offset " + std::to_string(chunk.address) +
                        ": found data that does not match its Adler-32 checksum; the file is damaged, use "
                        "another copy");
    }
}

TEST(hdf5_files_cut_off_anywhere_give_errors) {
    for (const char* name : {"small_old", "small_latest"}) {
        const std::string whole = hdf5_bytes(name);
        const bool old = whole[8] == 0;
        for (size_t size = 0; size < whole.size(); ++size) {
            std::string cut = whole.substr(0, size);
            CHECK_FAILS(size < 8 ? "hdf5.format" : "hdf5.truncated", parse(cut));
            if (size < 96) continue;
            set_u64(cut, old ? 40 : 28, size);  // the superblock now agrees, so the reader goes on
            if (!old) seal(cut, {{0, 44}});
            CHECK(survives(cut));
        }
    }
}

TEST(hdf5_files_changed_at_random_give_errors_or_values) {
    const Random random{test_seed(), 9};
    uint64_t step = 0;
    for (const char* name :
         {"small_old", "small_latest", "minari", "superblock2", "root_old", "root_latest", "tables"}) {
        const std::string whole = hdf5_bytes(name);
        const auto structures = checksummed(whole);
        std::vector<uint64_t> addresses = {undefined_address, whole.size() - 1, uint64_t{1} << 63, 0};
        std::vector<size_t> pointers;
        for (size_t at = 0; at + 8 <= whole.size(); ++at)
            if (u64(whole, at) >= 40 && u64(whole, at) < whole.size()) pointers.push_back(at);
        for (const size_t at : pointers) addresses.push_back(u64(whole, at));
        for (int round = 0; round < 1200; ++round, ++step) {
            std::string bytes = whole;
            const uint64_t changes = 1 + random.below(4, step, 0);
            for (uint32_t c = 1; c <= changes; ++c) {
                const size_t at = random.below(bytes.size() - 8, step, 4 * c);
                const uint64_t kind = random.below(4, step, 4 * c + 1), value = random.below(256, step, 4 * c + 2);
                if (kind == 0) bytes[at] = static_cast<char>(value);
                if (kind == 1) bytes[at] = static_cast<char>(bytes[at] ^ 1 << value % 8);
                if (kind == 2) bytes[at] = static_cast<char>(value < 128 ? 0 : 255);
                if (kind == 3)  // a pointer to something else, or in a circle
                    set_u64(bytes, pointers[random.below(pointers.size(), step, 4 * c + 3)],
                            addresses[random.below(addresses.size(), step, 4 * c + 2)]);
            }
            if (round % 2 == 0) seal(bytes, structures);  // past the checksums
            if (!survives(bytes))
                report_failure(__FILE__, __LINE__, std::string(name) + ": round " + std::to_string(round));
        }
    }
}

TEST(hdf5_writer_makes_files_that_the_reader_reads) {
    const Folder folder;
    const std::string path = folder / "out.hdf5";
    const size_t n = 300001;
    std::vector<float> floats(3 * n);
    std::vector<double> doubles(2 * n);
    std::vector<int32_t> integers(n);
    std::vector<uint8_t> flags(n);
    for (size_t i = 0; i < floats.size(); ++i) floats[i] = static_cast<float>(formula("float32", i));
    for (size_t i = 0; i < doubles.size(); ++i) doubles[i] = formula("float64", i);
    for (size_t i = 0; i < n; ++i) integers[i] = static_cast<int32_t>(formula("int32", i));
    for (size_t i = 0; i < n; ++i) flags[i] = static_cast<uint8_t>(formula("bool", i));
    const auto write = [&] {
        Hdf5Writer out(path);
        out.add("observations", {n, 3}, floats);
        out.add("infos/qpos", {n, 2}, doubles);
        out.add("infos/steps", {n}, integers);
        out.add("terminals", {n}, flags);
        out.add("none", {0, 3}, std::vector<float>());
        out.text("metadata/algorithm", "SAC");
        out.text("metadata/empty", "");
        out.add("metadata/iteration", {}, std::span<const int32_t>(integers).first(1));
        out.add("metadata/policy/fc0/weight", {5, 2}, std::span<const float>(floats).first(10));
        for (int i = 0; i < 40; ++i)
            out.add("many/episode_" + std::to_string(i), {1}, std::span<const int32_t>(integers).first(1));
        CHECK(!std::filesystem::exists(path) || read_file(path).size() > 0);
        out.close();
    };
    write();
    CHECK_EQUAL(std::distance(std::filesystem::directory_iterator(folder.path), {}), ptrdiff_t{1});
    const Hdf5File file = open_hdf5(path);
    check_contents("written", file, 49);
    CHECK_EQUAL(file.find("observations")->type, "float32");
    CHECK_EQUAL(file.find("infos/qpos")->type, "float64");
    CHECK_EQUAL(file.find("infos/steps")->type, "int32");
    CHECK_EQUAL(file.find("terminals")->type, "bool");
    CHECK(file.find("observations")->shape == (Shape{n, 3}));
    CHECK(file.find("metadata/iteration")->shape.empty());
    CHECK(file.read_flags(*file.find("terminals")) == flags);
    CHECK_EQUAL(read_text(file, *file.find("metadata/algorithm")), "SAC");
    CHECK_EQUAL(read_text(file, *file.find("metadata/empty")), "");
    const std::string digest = sha256_of_file(path);
    write();
    CHECK_EQUAL(sha256_of_file(path), digest);
}

TEST(hdf5_writer_refuses_what_does_not_fit) {
    const Folder folder;
    const std::string path = folder / "out.hdf5";
    const std::vector<float> three(3);
    const std::vector<uint8_t> flags = {0, 1, 2};
    const auto add = [&](Hdf5Writer& out, const std::string& name, const Shape& shape) { out.add(name, shape, three); };
    CHECK_FAILS("hdf5.shape", Hdf5Writer out(path); add(out, "a", {2}));
    CHECK_FAILS("hdf5.shape", Hdf5Writer out(path); add(out, "a", {4}));
    CHECK_FAILS("hdf5.shape", Hdf5Writer out(path); add(out, "a", {uint64_t{1} << 40, uint64_t{1} << 40}));
    CHECK_FAILS("hdf5.flag", Hdf5Writer out(path); out.add("a", {3}, flags));
    for (const char* name : {"", "/a", "a/", "a//b", "x", "x/y", "g", ".", "\xFF", "a\n"}) {
        CHECK_FAILS("hdf5.name", Hdf5Writer out(path); add(out, "x", {3}); add(out, "g/y", {3}); add(out, name, {3}));
    }
    CHECK_FAILS("file.write", Hdf5Writer out(folder / "missing/file"));
    CHECK(std::filesystem::is_empty(folder.path));

    const pid_t child = ::fork();  // a disk that is full after 4 kB
    if (child == 0) {
        std::signal(SIGXFSZ, SIG_IGN);
        const rlimit limit{4096, 4096};
        ::setrlimit(RLIMIT_FSIZE, &limit);
        try {
            Hdf5Writer out(path);
            for (int i = 0; i < 1000; ++i) add(out, std::to_string(i), {3});
            out.close();
        } catch (const Error& error) {
            ::_exit(error.id == "file.write" && error.what() == path + ": cannot write it: File too large" ? 7 : 1);
        }
        ::_exit(0);
    }
    int status = 0;
    CHECK(::waitpid(child, &status, 0) == child && WIFEXITED(status) && WEXITSTATUS(status) == 7);
    CHECK(std::filesystem::is_empty(folder.path));
}

// SPEC III.A.1: names of a child lie above the key on its left, up to that on its right; the library searches by them.
TEST(a_written_group_has_the_keys_that_a_search_by_name_needs) {
    const Folder folder;
    const std::string path = folder / "out.hdf5";
    Hdf5Writer out(path);
    for (const char* name : {"b", "c", "a"}) out.add(name, {1}, std::array{1.0f});
    out.close();
    const std::string bytes = read_file(path);
    const uint64_t tree = u64(bytes, 80), names = u64(bytes, u64(bytes, 88) + 24);
    CHECK_EQUAL(std::string(&bytes[names + u64(bytes, tree + 24)]), "");
    CHECK_EQUAL(std::string(&bytes[names + u64(bytes, tree + 40)]), "c");
}

TEST(hdf5_circles_end_in_errors) {
    const Folder folder;
    const std::string path = folder / "out.hdf5";
    {
        Hdf5Writer out(path);
        out.add("g/x", {1}, std::array{1.0f});
        out.close();
    }
    const std::string bytes = read_file(path);
    const uint64_t root = u64(bytes, 64), tree = u64(bytes, 80), leaf = u64(bytes, tree + 32);
    std::string circle = bytes;
    set_u64(circle, leaf + 16, root);  // "g" is the root group, which is visited once
    CHECK(parse(circle).datasets.empty() && parse(circle).find("g/g/g") == nullptr);
    CHECK_FAILS("hdf5.link", parse(circle).find("g/g/x"));
    circle = bytes;
    circle[root + 16] = 0x10;  // the header's only message: it continues where it is
    set_u64(circle, root + 24, root + 16);
    set_u64(circle, root + 32, 24);
    CHECK_FAILS("hdf5.cycle", parse(circle));
    circle = bytes;
    circle[tree + 5] = 2;  // its child, the node of "g", would have to have level 1
    set_u64(circle, tree + 32, u64(bytes, leaf + 32));
    CHECK_FAILS("hdf5.format", parse(circle));
    CHECK_FAILS("hdf5.format", parse(std::string(5000, 'x')));
    CHECK_FAILS("hdf5.format", parse(""));
    CHECK_FAILS("file.open", open_hdf5(folder / "missing"));
    CHECK_FAILS("file.not_regular", open_hdf5(folder.path.string()));
}

// Files that a writer could not make, with checksums that hold.
TEST(hdf5_blocks_too_small_and_layouts_that_come_twice_are_refused) {
    std::string bytes = hdf5_bytes("small_latest");
    const size_t heap = bytes.find("FRHP");
    CHECK(heap != std::string::npos);
    const auto structures = checksummed(bytes);
    for (const uint64_t size : {1, 2, 16}) {  // a block that has no room for its own checksum
        std::string damaged = bytes;
        set_u64(damaged, heap + 112, size);
        seal(damaged, structures);
        CHECK_FAILS("hdf5.truncated", parse(damaged));
    }
    const Folder folder;
    {
        Hdf5Writer out(folder / "out.hdf5");
        out.add("x", {2}, std::array{1.0f, 2.0f});
        out.close();
    }
    bytes = read_file(folder / "out.hdf5");
    const std::string fill("\5\0\x8\0\0\0\0\0\2\2\2\1", 12), layout("\x8\0\x18\0\0\0\0\0\3\1", 10);
    const size_t first = bytes.find(fill), second = bytes.find(layout);
    CHECK(second == first + 16);
    std::string twice = bytes;  // the fill value makes room, and what follows the header is not looked at
    twice.replace(first, 8 + 24, bytes.substr(second, 8 + 24));
    twice.replace(first + 8 + 24, 8 + 24, bytes.substr(second, 8 + 24));
    CHECK_FAILS("hdf5.format", parse(twice));
}

// The implicit index of [7, 5] values in chunks [2, 3] that may grow to [7, 2^64 - 2]: its last chunk's number,
// 3 (2^64 - 1) / 3 + 1, is 2^64, of which 64 bits leave 0.
TEST(hdf5_index_whose_last_number_overflows_is_refused) {
    std::string bytes = hdf5_bytes("latest");
    const auto structures = checksummed(bytes);
    std::string shape;
    for (const uint64_t extent : {7, 5, 7, 8}) shape.append(reinterpret_cast<const char*>(&extent), 8);
    const size_t at = bytes.find(shape);
    CHECK(at != std::string::npos && bytes.find(shape, at + 1) == std::string::npos);
    parse(bytes);
    set_u64(bytes, at + 24, ~uint64_t{1});
    seal(bytes, structures);
    CHECK_FAILS("hdf5.too_large", parse(bytes));
}

TEST(hdf5_sizes_out_of_proportion_are_refused) {
    const Folder folder;
    const std::string path = folder / "out.hdf5";
    {
        Hdf5Writer out(path);
        out.add("x", {3, 1}, std::array{1.0f, 2.0f, 3.0f});
        out.add("y", {5, 1}, std::vector<uint8_t>(5));
        out.close();
    }
    const std::string bytes = read_file(path);
    const size_t x = bytes.find(std::string("\3\0\0\0\0\0\0\0\1\0\0\0\0\0\0\0", 16));
    const size_t y = bytes.find(std::string("\5\0\0\0\0\0\0\0\1\0\0\0\0\0\0\0", 16));
    for (const uint64_t rows : {uint64_t{4}, uint64_t{1} << 25, uint64_t{1} << 32, uint64_t{1} << 62, ~uint64_t{0}}) {
        std::string damaged = bytes;
        set_u64(damaged, x, rows);
        CHECK_FAILS(rows == 4 ? "hdf5.format" : "hdf5.too_large", parse(damaged));
    }
    // Data that were never written need no bytes of the file. All data sets count, a byte as the float that it becomes.
    std::string unwritten = bytes;
    for (const auto& [name, shape] : {std::pair("x", x), {"y", y}}) {
        const uint64_t address = parse(bytes).find(name)->chunks[0].address;
        set_u64(unwritten, bytes.find(std::string(reinterpret_cast<const char*>(&address), 8), shape), ~uint64_t{0});
    }
    const uint64_t half = uint64_t{1} << 23;  // rows of 4 bytes, of 2^26 bytes
    for (const auto& [rows_of_x, rows_of_y] : {std::pair(half, half), {2 * half, half}, {3, 3 * half}}) {
        set_u64(unwritten, x, rows_of_x);
        set_u64(unwritten, y, rows_of_y);
        if (rows_of_x == half)
            CHECK_EQUAL(parse(unwritten).find("y")->elements, half);
        else
            CHECK_FAILS("hdf5.too_large", parse(unwritten));
    }
}

// Kinds of faults that were published of the HDF5 library (ROBUSTNESS.md), one file each: in a file of tests/hdf5 the
// bytes that lie `skip` after the first place of the letters are replaced. HDF5 2.0.0 itself refuses or reads each.
namespace {

struct Fault {
    std::string kind;
    std::string_view letters;
    int skip;
    std::string_view bytes;
    std::string said;  // a part of the message
};

using namespace std::string_view_literals;
const std::map<std::string, std::vector<Fault>> published_faults = {
    {"small_old",
     {{"superblock: addresses of 255 bytes", "\x89HDF"sv, 13, "\xFF"sv, "offsets and lengths of 8 bytes"},
      {"superblock: an end beyond the file", "\x89HDF"sv, 44, "\1"sv, "its superblock says 42949"},
      {"header: a message longer than its block", "\3\1\x33\x10"sv, 26, "\0\2"sv, "a message within its block"},
      {"header: a message flagged as shared", "\3\1\x33\x10"sv, -4, "\2"sv, "its layout is shared with other objects"},
      {"space: 255 dimensions", "\1\1\1\0\0\0\0\0\4"sv, 1, "\xFF"sv, "up to 32 dimensions"},
      {"space: more dimensions than fit", "\1\1\1\0\0\0\0\0\4"sv, 1, "\x20"sv, "8 bytes before"},
      {"space: a product of extents that overflows", "\5\0\0\0\0\0\0\0\3"sv, 4,
       "\2\0\0\0\3\0\0\0\2\0\0\0\5\0\0\0\2\0\0\0\3\0\0\0\2"sv, "a size of at most 64 bits"},
      {"space: gigabytes in a small file", "\1\1\1\0\0\0\0\0\4"sv, 12, "\2\0\0\0\4\0\0\0\2"sv, "in a file so small"},
      {"space: an extent above its limit", "\1\1\1\0\0\0\0\0\4"sv, 8, "\5"sv, "not above the largest allowed"},
      {"type: elements of 0 bytes", "\x11\x20\x3F\0"sv, 4, "\0"sv, "a data type of version 1 to 5"},
      {"type: longer than its message", "\3\0\x18\0\1\0\0\0\x11\x20\x3F\0"sv, 2,
       "\x08\0\1\0\0\0\x11\x20\x3F\0\x08\0\0\0\0\0\x08\0\0\0\0\0"sv, "12 bytes before"},
      {"type: more bits than its bytes have", "\x10\x08\0\0\2\0\0\0\0\0\x10"sv, 10, "\xFF"sv, "of type class 0"},
      {"type: enumerations larger than integers", "\x18\2\0\0\1"sv, 4, "\2"sv, "of the size of its integers"},
      {"type: an enumeration of enumerations", "\x18\2\0\0\1"sv, 8, "\x18"sv, "elements of type class 8"},
      {"fill value: longer than its message", "\2\2\2\1\0\0\0\0\x08\0\x18\0\0\0\0\0\3\1\x33"sv, 4, "\x08"sv,
       "8 bytes before"},
      {"fill value: larger than an element", "\2\2\2\1\0\0\0\0\x08\0\x18\0\0\0\0\0\3\1\x33"sv, 4, "\x20"sv,
       "a fill value of the data's type"},
      {"filters: 255", "\1\3\0\0\0\0\0\0\2\0"sv, 1, "\xFF"sv, "a list of up to 32 filters"},
      {"filters: more than fit", "\1\3\0\0\0\0\0\0\2\0"sv, 1, "\x20"sv, "2 bytes before"},
      {"filters: more parameters than fit", "\1\1\0\0\0\0\0\0\1\0"sv, 14, "\xFF\xFF"sv, "262144 bytes before"},
      {"chunk: shorter than its extents", "TREE\1\0\3"sv, 24, "\4"sv, "a chunk of another size than the others"},
      {"chunk: between two places", "TREE\1\0\3"sv, 32, "\1"sv, "begins at a multiple of its extents"},
      {"chunks: of fewer dimensions than the data", "\3\2\2\x70\x33"sv, 2, "\1"sv, "as many dimensions as the data"},
      {"chunks: of 0 elements", "\3\2\2\x70\x33"sv, 11, "\0"sv, "chunks that are not empty"},
      {"chunks: a size that overflows", "\3\2\3\x78\5"sv, 11, "\xFF\xFF\xFF\xFF\xFF\xFF\xFF\xFF"sv,
       "a size of at most 64 bits"},
      {"compact data: longer than their message", "\3\0\x18\0\0\0\0\0\0\0\x94"sv, 2, "\xFF\xFF"sv,
       "compact data within their message"},
      {"compact data: shorter than the extents", "\3\0\x18\0\0\0\0\0\0\0\x94"sv, 2, "\4"sv, "24 bytes of data"},
      {"contiguous data: shorter than the extents", "\3\1\x33\x10"sv, 10, "\4"sv, "32 bytes of data"},
      {"contiguous data: beyond the end", "\3\1\x33\x10"sv, 2, "\xF0\xFF\xFF\xFF\xFF\xFF\xFF\xFF"sv,
       "the file ends at"},
      {"symbol node: more entries than fit", "SNOD"sv, 6, "\xFF\xFF"sv, "a text within the heap"},
      {"symbol node: a name outside of the heap", "SNOD"sv, 10, "\1"sv, "a text within the heap"},
      {"local heap: a name that does not end", "HEAP"sv, 8, "\x2C"sv, "a text that ends"},
      {"local heap: longer than the file", "HEAP"sv, 13, "\1"sv, "the file ends at"},
      {"B-tree 1: a child of another level", "TREE"sv, 5,
       "\2\1\0\xFF\xFF\xFF\xFF\xFF\xFF\xFF\xFF\xFF\xFF\xFF\xFF\xFF\xFF\xFF\xFF\0\0\0\0\0\0\0\0\xD8\x17"sv,
       "a node one level below the last"},
      {"B-tree 1: more children than fit", "TREE"sv, 6, "\xFF\xFF"sv, "the signature SNOD"}}},
    {"small_latest",
     {{"superblock: a root group beyond the end", "\x89HDF"sv, 43, "\x40"sv, "the file ends at"},
      {"header: a block beyond the end", "OHDR\2\1"sv, 6, "\xFF\xFF"sv, "65535 bytes before 8667"},
      {"header: a continuation of 0 bytes", "\x10\x10\0\0\x74"sv, 12, "\0"sv, "a continuation block of at least 8"},
      {"link: a name longer than its message", "\1\0\1\x61"sv, 2, "\xFF"sv, "255 bytes before"},
      {"link information: longer than its message", "\2\x12\0\0\0\0\xF7"sv, 5, "\1"sv, "8 bytes before"},
      {"fractal heap: blocks of 0 bytes", "FRHP"sv, 112, "\0\0"sv, "a doubling table of powers of two"},
      {"fractal heap: a link outside of its blocks", "BTLF\0\5"sv, 11, "\xFF\xFF"sv, "a link within a block"},
      {"B-tree 2: records larger than a node", "BTHD\0\5"sv, 10, "\x58\2"sv, "room for records in a node"},
      {"B-tree 2: 65535 levels", "BTHD\0\5"sv, 12, "\xFF\xFF"sv, "room for records in a node"},
      {"fixed array: 2^62 chunks", "FAHD\0\0"sv, 15, "\x40"sv, "bytes before 8667"},
      {"fixed array: pages of 2^255 chunks", "FAHD\0\0"sv, 7, "\xFF"sv, "pages below 2^64 entries"},
      {"extensible array: 2^255 chunks", "EAHD"sv, 7, "\xFF"sv, "an index of at most 2^48 chunks"},
      {"extensible array: blocks of 0 chunks", "EAHD"sv, 9, "\0"sv, "an index of at most 2^48 chunks"}}},
    {"root_old",
     {{"header: a continuation beyond the end", "\x10\0\x10\0"sv, 12, "\1"sv, "the file ends at"},
      {"header: an old continuation of 0 bytes", "\x10\0\x10\0"sv, 16, "\0\0"sv, "a continuation block of at least 8"},
      {"header: a continuation of itself", "\x10\0\x10\0"sv, 8, "\x70\0\0\0\0\0\0\0\x18\0"sv, "in a circle"},
      {"attribute: a name longer than its message", "\1\0\x0F\0\x0C"sv, 3, "\1"sv, "272 bytes before"},
      {"attribute: a name that does not end", "total_episodes"sv, 14, "x"sv, "a text that ends"}}}};

// Reads all numbers there are. Returns the message of the first error, or nothing.
std::string refusal(const std::string& bytes) {
    try {
        const Hdf5File file = parse(bytes);
        for (const Hdf5Dataset& dataset : file.datasets)
            if (dataset.element.kind != Hdf5Element::text) file.read<double>(dataset);
        return "";
    } catch (const Error& error) {
        return error.what();
    }
}

// Kilobytes of memory that this process has (VmRSS), or had at most (VmHWM) since `5` was written to clear_refs.
long kilobytes(const std::string& which) {
    std::ifstream status("/proc/self/status");
    for (std::string word; status >> word;)
        if (word == which + ":") return status >> word, std::stol(word);
    return -1;
}

}  // namespace

TEST(hdf5_faults_published_of_the_library_are_refused_in_time_and_memory) {
    for (const auto& [name, faults] : published_faults) {
        const std::string whole = hdf5_bytes(name);
        const auto structures = checksummed(whole);
        CHECK_EQUAL(refusal(whole), "");
        for (const auto& [kind, letters, skip, bytes, said] : faults) {
            std::string damaged = whole;
            damaged.replace(whole.find(letters) + static_cast<size_t>(skip), bytes.size(), bytes);
            seal(damaged, structures);
            std::ofstream("/proc/self/clear_refs") << 5;
            const long before = kilobytes("VmRSS");
            const auto start = std::chrono::steady_clock::now();
            const std::string message = refusal(damaged);
            const std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - start;
            const long taken = kilobytes("VmHWM") - before;
            if (message.find(said) == std::string::npos || seconds.count() > 1 || taken > 64 << 10)
                report_failure(__FILE__, __LINE__,
                               text_of(kind, ": ", seconds.count(), " s, ", taken, " kB: ", message));
        }
    }
    // The function alone: a file with so short a chunk could harm other readers.
    CHECK_FAILS("hdf5.checksum", Hdf5File::without_checksum(as_bytes(hdf5_bytes("small_old")).first(3)));
}
