// hdf5.hpp: reads the data sets that others published as HDF5 (D4RL's files, Minari's, whatever h5py writes), writes
// plain ones that any h5py reads, and takes the SHA-256 of a file, by which a published file is recognised.
//
// SPEC below is the "HDF5 File Format Specification Version 3.0" (The HDF Group); no code of theirs was used.
// Promises: what is read is what h5py reads; every checksum of what is read is verified; no input crashes or hangs the
// reader or makes it allocate out of proportion; every error names the file, the object, the offset and what was
// expected there. Leaves out: attributes but single numbers of the root group, compound, variable-length and other
// types, filters but shuffle, deflate, LZF and fletcher32, external links, shared messages, committed types, virtual
// data sets (these data sets are listed, and refused by name when read), layout messages before version 3 (HDF5 1.6.2
// and older), reading a part of the rows.
#pragma once

#include <deque>
#include <set>

#include "safetensors.hpp"

using Bytes = std::span<const uint8_t>;

inline Bytes as_bytes(std::string_view text) { return {reinterpret_cast<const uint8_t*>(text.data()), text.size()}; }

// Returns the first 8 bytes, or fewer, as a number, least significant first.
inline uint64_t little_endian(Bytes bytes) {
    uint64_t value = 0;
    if (!bytes.empty()) std::memcpy(&value, bytes.data(), std::min<size_t>(bytes.size(), 8));
    return value;
}

// Returns what a sentence about one data set of a file begins with.
inline std::string dataset_place(const std::string& file, const std::string& dataset) {
    return file + ": " + json_string(dataset) + ": ";
}

// ---------------------------------------------------------------------------------------------------------------------
// Checksums

// Returns the first 32 bits of the fractions of the cube roots of the first 64 primes (FIPS 180-4, section 4.2.2).
inline std::array<uint32_t, 64> sha256_constants() {
    std::array<uint32_t, 64> constants;
    size_t found = 0;
    for (uint32_t n = 2; found < constants.size(); ++n) {
        bool prime = true;
        for (uint32_t divisor = 2; divisor * divisor <= n; ++divisor) prime = prime && n % divisor != 0;
        const double root = std::cbrt(n);  // of its 53 bits 35 are needed
        if (prime) constants[found++] = static_cast<uint32_t>((root - std::floor(root)) * 0x1p32);
    }
    return constants;
}

// Returns the SHA-256 of a message (FIPS 180-4, section 6.2.2, with its letters) as 64 hexadecimal digits.
inline std::string sha256(Bytes message) {
    static const std::array<uint32_t, 64> constants = sha256_constants();
    std::array<uint32_t, 8> hash = {0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a,
                                    0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
    // Section 5.1.1: after the message come a one bit, zeros, and the message's length in bits, u64 big-endian.
    const size_t whole = message.size() / 64 * 64;  // bytes in full blocks
    std::vector<uint8_t> last(message.begin() + whole, message.end());
    last.push_back(0x80);
    last.resize((last.size() + 8 + 63) / 64 * 64);
    const uint64_t length = __builtin_bswap64(8 * message.size());
    std::memcpy(&last[last.size() - 8], &length, 8);
    for (size_t at = 0; at < whole + last.size(); at += 64) {
        std::array<uint32_t, 64> w;
        std::memcpy(w.data(), at < whole ? &message[at] : &last[at - whole], 64);
        for (size_t t = 0; t < 16; ++t) w[t] = __builtin_bswap32(w[t]);
        for (size_t t = 16; t < 64; ++t) {
            const uint32_t x = w[t - 15], y = w[t - 2];
            const uint32_t s0 = std::rotr(x, 7) ^ std::rotr(x, 18) ^ x >> 3;
            w[t] = (std::rotr(y, 17) ^ std::rotr(y, 19) ^ y >> 10) + w[t - 7] + s0 + w[t - 16];
        }
        std::array<uint32_t, 8> v = hash;
        for (size_t t = 0; t < 64; ++t) {
            const auto [a, b, c, d, e, f, g, h] = v;
            const uint32_t s1 = std::rotr(e, 6) ^ std::rotr(e, 11) ^ std::rotr(e, 25);
            const uint32_t s0 = std::rotr(a, 2) ^ std::rotr(a, 13) ^ std::rotr(a, 22);
            const uint32_t t1 = h + s1 + ((e & f) ^ (~e & g)) + constants[t] + w[t];
            const uint32_t t2 = s0 + ((a & b) ^ (a & c) ^ (b & c));
            v = {t1 + t2, a, b, c, d + t1, e, f, g};
        }
        for (size_t i = 0; i < 8; ++i) hash[i] += v[i];
    }
    std::string digits;
    for (const uint32_t word : hash) digits += hex8(word);
    return digits;
}

inline std::string sha256_of_file(const std::string& path) { return sha256(as_bytes(read_file(path))); }

// Bob Jenkins's lookup3, hashlittle() with initial value 0: the checksum of the newer structures
// (http://burtleburtle.net/bob/hash/doobs.html).
inline uint32_t lookup3(Bytes key) {
    constexpr int mix[] = {4, 6, 8, 16, 19, 4}, last[] = {14, 11, 25, 16, 4, 14, 24};
    std::array<uint32_t, 3> s;
    s.fill(0xDEADBEEF + static_cast<uint32_t>(key.size()));
    if (key.empty()) return s[2];
    while (true) {
        const Bytes part = key.first(std::min<size_t>(key.size(), 12));  // where bytes are missing they are zeros
        for (size_t i = 0; i < part.size(); ++i) s[i / 4] += uint32_t{part[i]} << (8 * (i % 4));
        key = key.subspan(part.size());
        if (key.empty()) break;
        for (size_t i = 0; i < std::size(mix); ++i) {
            uint32_t &x = s[i % 3], &y = s[(i + 2) % 3];
            x = (x - y) ^ std::rotl(y, mix[i]);
            y += s[(i + 1) % 3];
        }
    }
    for (size_t i = 0; i < std::size(last); ++i) {
        uint32_t &x = s[(i + 2) % 3], y = s[(i + 1) % 3];
        x = (x ^ y) - std::rotl(y, last[i]);
    }
    return s[2];
}

// Returns {first + the sum of value(i) over i < count, the sum of the sums so far}, modulo m. Values have 16 bits, so
// that no sum reaches 2^64 between two reductions.
std::array<uint64_t, 2> running_sums(size_t count, uint64_t first, uint64_t m, const auto& value) {
    uint64_t sum = first, sums = 0;
    for (size_t i = 0; i < count; sum %= m, sums %= m)
        for (const size_t end = std::min<size_t>(count, i + 4096); i < end; ++i) {
            sum += value(i);
            sums += sum;
        }
    return {sum, sums};
}

// Fletcher's checksum of big-endian 16-bit words, as HDF5's filter 3 takes it: modulo 65535, where 65535 stands for 0
// unless all words are zero.
inline uint32_t fletcher32(Bytes bytes) {
    const auto word = [&](size_t i) { return bytes[2 * i] << 8 | (2 * i + 1 < bytes.size() ? bytes[2 * i + 1] : 0); };
    const auto [low, high] = running_sums((bytes.size() + 1) / 2, 0, 65535, word);
    if (std::ranges::all_of(bytes, [](uint8_t byte) { return byte == 0; })) return 0;
    return static_cast<uint32_t>((high == 0 ? 65535 : high) << 16 | (low == 0 ? 65535 : low));
}

// RFC 1950, sections 2.2 and 8.
inline uint32_t adler32(Bytes bytes) {
    const auto [low, high] = running_sums(bytes.size(), 1, 65521, [&](size_t i) { return bytes[i]; });
    return static_cast<uint32_t>(high << 16 | low);
}

// ---------------------------------------------------------------------------------------------------------------------
// Inflate (RFC 1951, the sections named below), in the wrapper of RFC 1950. The lowest bit of a byte is read first.
//
//   stream   78 9C (or like it) | block | block ... | to the next byte | Adler-32 of the data, big-endian
//   block    last block? 1 bit | type 2 bits | contents
//              type 0: to the next byte | n u16 | ~n u16 | n bytes as they are               (3.2.4)
//              type 1: symbols in two fixed codes                                            (3.2.6)
//              type 2: the lengths of two codes, themselves coded | symbols in these codes   (3.2.7)
//   symbol   0..255: a byte | 256: the end of the block | 257..285: a length of 3..258, extra bits, then, in the second
//            code, a distance of 1..32768 (0..29), extra bits: that many bytes, from that far back, once more

[[noreturn]] inline void bad_stream(const char* found) { throw Error("hdf5.deflate", found); }

// A Huffman code. Section 3.2.2: the lengths determine it. Codes of one length are consecutive numbers in the order of
// their symbols, and follow the shorter ones; the first bit read is a code's highest.
struct HuffmanCode {
    uint32_t mask = 0;                      // of the bits of the longest code
    std::array<uint16_t, 1 << 15> entries;  // by the next bits: symbol << 4 | length of its code; 0: none begins so

    // lengths[s]: bits of the code of symbol s, at most 15; 0: no code. Returns false unless the code is complete, but
    // for one of a single bit or none at all (section 3.2.7).
    bool build(std::span<const uint8_t> lengths) {
        const uint32_t longest = std::ranges::max(lengths);
        mask = (1u << longest) - 1;
        std::fill_n(entries.begin(), mask + 1, uint16_t{0});
        uint32_t next = 0;  // the next code, in the highest of 15 bits; 2^15: none is left
        for (uint32_t length = 1; length <= longest; ++length)
            for (size_t s = 0; s < lengths.size(); ++s) {
                if (lengths[s] != length) continue;
                if (next >= 1 << 15) return false;
                uint32_t reversed = 0;
                for (uint32_t bit = 0; bit < length; ++bit) reversed |= (next >> (14 - bit) & 1) << bit;
                for (uint32_t i = reversed; i <= mask; i += 1u << length)
                    entries[i] = static_cast<uint16_t>(s << 4 | length);
                next += 1u << (15 - length);
            }
        return next == 0 || next == 1 << 15 || longest == 1;
    }
};

struct BitReader {
    const uint8_t *in, *in_end;
    uint64_t bits = 0;  // read, not yet taken
    int count = 0;      // number of these bits; below 0: the input ended, and zeros were taken for it

    // Makes at least 57 bits ready, as long as there is input.
    void refill() {
        if (count < 0) bad_stream("the end of the compressed data");
        for (; count <= 56 && in < in_end; count += 8) bits |= static_cast<uint64_t>(*in++) << count;
    }
    uint32_t take(uint32_t n) {  // n < 32
        const auto value = static_cast<uint32_t>(bits & ((uint64_t{1} << n) - 1));
        bits >>= n;
        count -= static_cast<int>(n);
        return value;
    }
    uint32_t decode(const HuffmanCode& code) {
        const uint32_t entry = code.entries[bits & code.mask];
        if (entry == 0) bad_stream("a code that stands for nothing");
        take(entry & 15);
        return entry >> 4;
    }
    // Section 3.2.5: a symbol is a number's highest bits, extra bits are the rest: one more for every `period` symbols.
    uint32_t number(uint32_t symbol, uint32_t period) {
        if (symbol < 2 * period) return symbol;
        const uint32_t extra = symbol / period - 1;
        return ((period + symbol % period) << extra) + take(extra);
    }
};

// Errors: hdf5.deflate with what was found.
struct Inflater {
    BitReader source;
    std::span<uint8_t> out;
    size_t done = 0;  // bytes of `out`
    HuffmanCode symbols = {}, distances = {};

    void stored() {
        const Bytes left(source.in - source.count / 8, source.in_end);  // whole bytes go back
        if (left.size() < 4) bad_stream("the end of the compressed data");
        const size_t size = little_endian(left.first(2));
        if (size + little_endian(left.subspan(2, 2)) != 65535)
            bad_stream("a stored block whose length does not match its complement");
        if (left.size() - 4 < size) bad_stream("the end of the compressed data");
        if (out.size() - done < size) bad_stream("more data than the chunk holds");
        std::ranges::copy(left.subspan(4, size), out.begin() + done);
        done += size;
        source = {left.data() + 4 + size, source.in_end};
    }

    void fixed_codes() {
        std::array<uint8_t, 288> lengths;
        for (size_t s = 0; s < 288; ++s) lengths[s] = s < 144 ? 8 : s < 256 ? 9 : s < 280 ? 7 : 8;
        symbols.build(lengths);
        lengths.fill(5);
        distances.build(std::span(lengths).first(32));
    }

    void read_codes() {
        constexpr uint8_t order[19] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
        constexpr uint8_t least[3] = {3, 3, 11}, extra[3] = {2, 3, 7};  // of symbols 16 to 18: repetitions, extra bits
        source.refill();
        const size_t n_symbols = source.take(5) + 257, n_distances = source.take(5) + 1, n_order = source.take(4) + 4;
        if (n_symbols > 286 || n_distances > 30) bad_stream("too many codes");
        std::array<uint8_t, 19> first{};  // lengths of the code of lengths
        for (size_t i = 0; i < n_order; ++i) {
            source.refill();
            first[order[i]] = static_cast<uint8_t>(source.take(3));
        }
        if (!symbols.build(first)) bad_stream("an invalid code of code lengths");
        std::vector<uint8_t> lengths;
        while (lengths.size() < n_symbols + n_distances) {
            source.refill();
            const uint32_t symbol = source.decode(symbols);
            if (symbol == 16 && lengths.empty()) bad_stream("a repeated code length before the first");
            const auto value = static_cast<uint8_t>(symbol < 16 ? symbol : symbol == 16 ? lengths.back() : 0);
            const size_t times = symbol < 16 ? 1 : least[symbol - 16] + source.take(extra[symbol - 16]);
            lengths.insert(lengths.end(), times, value);
        }
        if (lengths.size() > n_symbols + n_distances) bad_stream("more code lengths than codes");
        if (lengths[256] == 0) bad_stream("no code for the end of the block");
        const std::span<const uint8_t> all(lengths);
        const bool valid = symbols.build(all.first(n_symbols)) && distances.build(all.last(n_distances));
        if (!valid) bad_stream("an invalid set of code lengths");
    }

    void compressed() {
        // Local copies: for all the compiler knows, a byte written to `out` could be in *this.
        BitReader s = source;
        uint8_t* to = out.data() + done;
        uint8_t* const end = out.data() + out.size();
        while (true) {
            s.refill();  // a length, a distance and the extra bits of both take 48 at most
            const uint32_t symbol = s.decode(symbols);
            if (symbol == 256) break;
            if (symbol < 256) {
                if (to == end) bad_stream("more data than the chunk holds");
                *to++ = static_cast<uint8_t>(symbol);
                continue;
            }
            if (symbol > 285) bad_stream("a code that stands for nothing");
            const size_t length = symbol == 285 ? 258 : 3 + s.number(symbol - 257, 4);
            const uint32_t far = s.decode(distances);
            if (far > 29) bad_stream("a code that stands for nothing");
            const size_t distance = 1 + s.number(far, 2);
            if (distance > static_cast<size_t>(to - out.data())) bad_stream("a distance to before the start");
            if (length > static_cast<size_t>(end - to)) bad_stream("more data than the chunk holds");
            const uint8_t* from = to - distance;
            for (size_t i = 0; i < length; ++i) *to++ = *from++;  // may read what it wrote: a repeated pattern
        }
        source = s;
        done = static_cast<size_t>(to - out.data());
    }

    void run() {
        for (bool last = false; !last;) {
            source.refill();
            last = source.take(1) == 1;
            const uint32_t type = source.take(2);
            if (type == 0) stored();
            if (type == 1) fixed_codes();
            if (type == 2) read_codes();
            if (type == 3) bad_stream("a block of type 3");
            if (type > 0) compressed();
        }
        if (source.count < 0) bad_stream("the end of the compressed data");
        source.in -= source.count / 8;
    }
};

// Returns the data, which must be `size` bytes. Errors: hdf5.deflate with what was found.
inline std::vector<uint8_t> inflate_zlib(Bytes in, size_t size) {
    const bool header = in.size() >= 6 && (in[0] & 15) == 8 && in[0] >> 4 <= 7 && (in[0] << 8 | in[1]) % 31 == 0;
    if (!header || (in[1] & 32) != 0) bad_stream("no zlib header");  // 32: with a dictionary
    std::vector<uint8_t> out(size);
    const BitReader source{in.data() + 2, in.data() + in.size() - 4};
    const auto state = std::make_unique<Inflater>(source, out);  // 128 kB
    state->run();
    if (state->done != size) bad_stream("less data than the chunk holds");
    if (state->source.in != source.in_end) bad_stream("bytes after the end of the compressed data");
    if (__builtin_bswap32(static_cast<uint32_t>(little_endian(in.last(4)))) != adler32(out))
        bad_stream("data that does not match its Adler-32 checksum");
    return out;
}

// LZF, the filter that h5py brings along, as its library LibLZF describes it: runs of new bytes and references back.
//   000nnnnn                       the next n + 1 bytes as they are
//   nnnooooo [m] oooooooo          n from 1 to 6: n + 2 bytes once more, from o + 1 bytes back; n = 7: m more bytes
// Returns the data, which must be `size` bytes. Errors: hdf5.lzf with what was found.
inline std::vector<uint8_t> decompress_lzf(Bytes in, size_t size) {
    std::vector<uint8_t> out;
    out.reserve(size);
    size_t at = 0;
    const auto next = [&] {
        require(at < in.size(), "hdf5.lzf", "the end of the compressed data");
        return in[at++];
    };
    while (at < in.size()) {
        const size_t head = next(), n = head >> 5;
        const bool copies = n > 0;
        size_t count = copies ? n + 2 : head + 1, back = 0;
        if (n == 7) count += next();
        if (copies) back = ((head & 31) << 8 | next()) + 1;
        require(back <= out.size(), "hdf5.lzf", "a distance to before the start");
        require(count <= size - out.size(), "hdf5.lzf", "more data than the chunk holds");
        for (; count > 0; --count) out.push_back(copies ? out[out.size() - back] : next());
    }
    require(out.size() == size, "hdf5.lzf", "less data than the chunk holds");
    return out;
}

// ---------------------------------------------------------------------------------------------------------------------
// What a file holds

// How one element is stored (SPEC IV.A.2.d).
struct Hdf5Element {
    enum Kind : uint8_t { other, floating, signed_integer, unsigned_integer, text } kind = other;
    bool big_endian = false;
    size_t size = 0;  // bytes; of numbers at most 8
};

// Returns the number stored at `from`, rounded to the nearest T.
template <class T>
T element_value(const Hdf5Element& element, const uint8_t* from) {
    const int unused = 64 - 8 * static_cast<int>(element.size);
    uint64_t bits = 0;
    std::memcpy(&bits, from, element.size);
    if (element.big_endian) bits = __builtin_bswap64(bits) >> unused;
    if (element.kind == Hdf5Element::unsigned_integer) return static_cast<T>(bits);
    if (element.kind == Hdf5Element::signed_integer)
        return static_cast<T>(static_cast<int64_t>(bits << unused) >> unused);
    if (element.size == 2) return static_cast<T>(half_value(static_cast<uint16_t>(bits)));
    if (element.size == 4) return static_cast<T>(std::bit_cast<float>(static_cast<uint32_t>(bits)));
    return static_cast<T>(std::bit_cast<double>(bits));
}

template <class T>
void convert_elements(const Hdf5Element& element, Bytes from, T* to) {
    if (std::is_same_v<T, float> && element.kind == Hdf5Element::floating && element.size == 4 && !element.big_endian) {
        if (!from.empty()) std::memcpy(to, from.data(), from.size());
        return;
    }
    for (size_t at = 0; at < from.size(); at += element.size) *to++ = element_value<T>(element, &from[at]);
}

struct Hdf5Chunk {
    uint64_t address, size;  // where and how many bytes in the file
    uint32_t skipped = 0;    // bit i: filter i was not applied
    Shape place = {};        // which one, in each dimension, of the data set's chunks; of data in one run: {}
};

enum class Hdf5Filter : uint16_t { deflate = 1, shuffle = 2, fletcher = 3, lzf = 32000 };

// The names of others, and how their data can be read all the same.
constexpr std::pair<uint64_t, const char*> other_filters[] = {
    {4, "szip"},      {5, "n-bit"},   {6, "scale-offset"},   {305, "LZO"},    {307, "bzip2"},
    {32001, "Blosc"}, {32004, "LZ4"}, {32008, "bitshuffle"}, {32015, "Zstd"}, {32026, "Blosc2"}};
constexpr const char* repack_advice = "; h5repack -f GZIP=4 OLD NEW (of HDF5's tools) writes a file that can be read";

// All chunks of a data set have the same extents. Shape (4, 5) in chunks of (2, 2) has 2 times 3; the last chunk of
// each row hangs over the edge. Each chunk is filtered by itself; one that is missing has the fill value.
struct Hdf5Dataset {
    std::string path;         // "infos/qpos": no slash at the start
    Shape shape;              // {}: a scalar
    std::string type;         // for people: "float32", "bool", "text of 3 bytes", "compound"
    size_t stored = 0;        // bytes that the data take in the file, compressed if they are
    std::string unsupported;  // why it cannot be read; empty: it can

    Hdf5Element element;
    Shape chunk;                           // extents of a chunk; of data in one run: the shape
    std::vector<Hdf5Filter> filters;       // in the order in which the writer applied them
    Bytes fill;                            // one element as stored; empty: zeros
    std::vector<Hdf5Chunk> chunks;         // those that exist
    size_t elements = 1, chunk_bytes = 0;  // products that fit 64 bits: checked when the file is opened
};

struct Hdf5File {
    std::string path;
    std::shared_ptr<const std::string> owner;       // of `bytes`
    Bytes bytes;                                    // the file from its superblock on; all addresses count from there
    std::vector<Hdf5Dataset> datasets;              // sorted by path, bytewise
    std::map<std::string, std::string> links = {};  // soft, external, to a group met before: path -> where it leads
    std::set<std::string> groups = {};              // paths; of one that several hard links lead to, the first
    std::map<std::string, double> attributes = {};  // of the root group, if a single number each

    // Returns the data set of this path, which may lead through links; null if there is none, or a group.
    // Errors: hdf5.link for a link to what is not in the file.
    const Hdf5Dataset* find(const std::string& name) const {
        std::string at = name;
        for (size_t followed = 0; followed < 32; ++followed) {
            const auto found = std::ranges::lower_bound(datasets, at, {}, &Hdf5Dataset::path);
            if (found != datasets.end() && found->path == at) return &*found;
            size_t end = at.find('/');  // of the part of `at` that is a link
            while (end != std::string::npos && !links.contains(at.substr(0, end))) end = at.find('/', end + 1);
            const auto link = links.find(at.substr(0, end));
            if (link == links.end() && (followed == 0 || groups.contains(at))) return nullptr;
            if (link == links.end()) break;
            at = link->second + (end == std::string::npos ? "" : at.substr(end));
            if (at.starts_with('/')) at.erase(0, 1);  // a link to the root group
        }
        throw Error("hdf5.link", dataset_place(path, name) + "is a link to " + json_string(at) +
                                     ", which is no data set of this file");
    }

    // Returns the paths of all data sets and links.
    std::vector<std::string> names() const {
        std::vector<std::string> all;
        for (const Hdf5Dataset& dataset : datasets) all.push_back(dataset.path);
        for (const auto& [from, to] : links) all.push_back(from);
        return all;
    }

    // Returns booleans, stored as any kind of number. Errors: those of read; hdf5.flag for anything but 0 and 1.
    std::vector<uint8_t> read_flags(const Hdf5Dataset& dataset) const {
        const std::vector<double> values = read<double>(dataset);
        const auto other = std::ranges::find_if(values, [](double value) { return value != 0 && value != 1; });
        require(other == values.end(), "hdf5.flag", dataset_place(path, dataset.path), "element ",
                other - values.begin(), " is neither 0 nor 1, so this is no data set of flags");
        return {values.begin(), values.end()};
    }

    // Returns all elements, row-major, each rounded to the nearest T (beyond the range: infinity).
    // Errors: hdf5.unsupported, hdf5.type, hdf5.deflate, hdf5.lzf, hdf5.checksum, hdf5.format.
    template <class T>
    std::vector<T> read(const Hdf5Dataset& dataset) const {
        const Hdf5Element& element = dataset.element;
        const std::string place = dataset_place(path, dataset.path);
        require(dataset.unsupported.empty(), "hdf5.unsupported", place, "cannot be read: ", dataset.unsupported);
        require(element.kind != Hdf5Element::text, "hdf5.type", place, "is ", dataset.type, ", expected numbers");
        std::vector<T> out(dataset.elements,
                           dataset.fill.empty() ? T{} : element_value<T>(element, dataset.fill.data()));
        std::vector<uint8_t> buffer;
        for (const Hdf5Chunk& chunk : dataset.chunks) {
            const Bytes data = decode(dataset, chunk, buffer);
            if (dataset.chunk == dataset.shape)
                convert_elements(element, data, out.data());
            else
                convert_chunk(dataset, chunk.place, data, out.data(), out.size());
        }
        return out;
    }

    // Returns the chunk_bytes bytes of a chunk, its filters undone from the last to the first (SPEC IV.A.2.l). They lie
    // in the file or in the buffer.
    Bytes decode(const Hdf5Dataset& dataset, const Hdf5Chunk& chunk, std::vector<uint8_t>& buffer) const {
        std::vector<Hdf5Filter> filters;  // that were applied
        for (size_t i = 0; i < dataset.filters.size(); ++i)
            if ((chunk.skipped >> i & 1) == 0) filters.push_back(dataset.filters[i]);
        size_t sums = std::ranges::count(filters, Hdf5Filter::fletcher);  // that are still to be taken off
        Bytes data = bytes.subspan(chunk.address, chunk.size);
        try {
            for (const Hdf5Filter filter : std::views::reverse(filters)) {
                const size_t size = dataset.chunk_bytes + 4 * sums;  // before it was compressed
                if (filter == Hdf5Filter::deflate) buffer = inflate_zlib(data, size);
                if (filter == Hdf5Filter::lzf) buffer = decompress_lzf(data, size);
                if (filter == Hdf5Filter::shuffle) buffer = unshuffled(data, dataset.element.size);
                data = filter == Hdf5Filter::fletcher ? without_checksum(data) : buffer;
                sums -= filter == Hdf5Filter::fletcher;
            }
            require(data.size() == dataset.chunk_bytes, "hdf5.format", "a chunk of another size than the others");
        } catch (const Error& error) {
            throw Error(error.id, text_of(dataset_place(path, dataset.path), "chunk at offset ", chunk.address,
                                          ": found ", error.what(), "; the file is damaged, use another copy"));
        }
        return data;
    }

    static Bytes without_checksum(Bytes data) {
        require(data.size() >= 4, "hdf5.checksum", "no room for a checksum");
        const Bytes covered = data.first(data.size() - 4);
        const bool holds = little_endian(data.last(4)) == fletcher32(covered);
        require(holds, "hdf5.checksum", "data that do not match their Fletcher-32 checksum");
        return covered;
    }

    // Shuffled data are byte 0 of all elements, then byte 1 of all, ...; a rest below one element stays in place.
    static std::vector<uint8_t> unshuffled(Bytes data, size_t width) {
        std::vector<uint8_t> out(data.begin(), data.end());
        const size_t count = data.size() / width;
        for (size_t j = 0; j < width; ++j)
            for (size_t k = 0; k < count; ++k) out[k * width + j] = data[j * count + k];
        return out;
    }

    // Converts the part of a chunk that lies within the data set: of its dimensions from k on, with `size` elements in
    // all, to the array that begins at `out`.
    static void convert_chunk(const Hdf5Dataset& dataset, const Shape& place, Bytes data, auto* out, size_t size,
                              size_t k = 0) {
        const size_t extent = dataset.shape[k], in_chunk = dataset.chunk[k], start = place[k] * in_chunk;
        const size_t inside = std::min(in_chunk, extent - start), row = data.size() / in_chunk, stride = size / extent;
        out += start * stride;
        if (k + 1 == place.size()) return convert_elements(dataset.element, data.first(inside * row), out);
        for (size_t i = 0; i < inside; ++i)
            convert_chunk(dataset, place, data.subspan(i * row, row), out + i * stride, stride, k + 1);
    }
};

// ---------------------------------------------------------------------------------------------------------------------
// Reading the structures
//
//   superblock ---> root group ----> link "actions" ----> object header of a data set
//   (where the      object header    link "infos" --+       dataspace  (4, 5)
//   root group is)  + links          ...            |       datatype   float32, either byte order
//                                                   |       filters    shuffle, deflate, fletcher32
//                        group "infos": the same <--+       fill value
//                        again, one level down              layout --> one run of bytes, or an index of chunks
//
//   links of a group   a symbol table: B-tree 1 of symbol nodes, names in a local heap          (old files)
//                      link messages in the header, or in a fractal heap found by a B-tree 2    (new files)
//   index of chunks    layout 3: B-tree 1. Layout 4: single chunk, implicit (chunk after chunk), fixed array,
//                      extensible array (one dimension unlimited), B-tree 2 (several unlimited)
//   All numbers are little-endian, addresses and lengths u64; the undefined address is 2^64 - 1 (SPEC V). Newer
//   structures begin with four letters and a version and end with the lookup3 checksum of all before it.

inline constexpr uint64_t undefined_address = ~uint64_t{0};

// SPEC II.A. The place of the signature in a file of `size` bytes: 0, 512, 1024, 2048, ..., since a user block may come
// before it. peek(at) returns the 8 bytes there.
std::optional<size_t> superblock_place(size_t size, const auto& peek) {
    for (size_t at = 0; at + 8 <= size; at = at == 0 ? 512 : 2 * at)
        if (peek(at) == "\x89HDF\r\n\x1a\n") return at;
    return {};
}

// The same of a file on the disk, of which it reads no more. Errors: file.open, file.not_regular, file.read.
inline bool has_superblock(const std::string& path) {
    const File file(path, O_RDONLY, "file.open", "open it");
    std::string bytes(8, '\0');
    const auto peek = [&](size_t at) { return file.read_at(at, bytes.data(), 8) == 8 ? bytes : ""; };
    return superblock_place(file.size(), peek).has_value();
}

// Structures that refer to each other in a circle end when more has been read than `budget`, a few times the size of
// the file; this also bounds what is allocated. A group is visited once, whatever hard links lead to it.
struct Hdf5Parser {
    Hdf5File& file;
    size_t budget = 16 * file.bytes.size() + (1 << 21);
    uint64_t promised = 0;                                      // bytes of all data sets so far, read as floats
    std::string object = "superblock";                          // being read, for messages
    std::map<uint64_t, std::string> groups = {};                // visited: address -> path
    std::deque<std::pair<std::string, uint64_t>> objects = {};  // to visit: path, address

    // Fails with what was expected at this offset, unless the condition holds.
    void require_at(uint64_t offset, bool holds, const char* id, const auto&... expected) const {
        require(holds, id, file.path, ": ", object, ": offset ", offset, ": expected ", expected...,
                "; the file is damaged or of a kind unknown to this reader");
    }
    void require_inside(uint64_t offset, uint64_t n) const {
        const uint64_t end = file.bytes.size();
        require_at(offset, offset <= end && n <= end - offset, "hdf5.truncated", n, " bytes (the file ends at ", end,
                   ")");
    }
    void charge(uint64_t offset, uint64_t n) {
        require_at(offset, n <= budget, "hdf5.cycle", "an end: structures refer to each other in a circle");
        budget -= n;
    }
    uint64_t product(uint64_t a, uint64_t b, uint64_t offset) const {
        const bool overflow = __builtin_mul_overflow(a, b, &a);
        require_at(offset, !overflow, "hdf5.too_large", "a size of at most 64 bits");
        return a;
    }
    static uint64_t quotient(uint64_t a, uint64_t b) { return a / b + (a % b != 0 ? 1 : 0); }  // rounded up
    static uint64_t log2(uint64_t value) { return static_cast<uint64_t>(std::bit_width(value)) - 1; }

    // Reads one field after the other from [at, end), which lies in the file.
    struct Cursor {
        Hdf5Parser& parser;
        uint64_t at, end;
        uint64_t start = at;

        Bytes take(uint64_t n) {
            parser.require_at(at, n <= end - at, "hdf5.truncated", n, " bytes before ", end);
            parser.charge(at, n);
            at += n;
            return parser.file.bytes.subspan(at - n, n);
        }
        uint64_t number(uint64_t size) { return little_endian(take(size)); }
        // Returns the next fields, given their sizes in bytes; one of more than 8 bytes is not needed here.
        auto fields(auto... sizes) {
            return std::array{number(static_cast<uint64_t>(sizes))...};  // braces: from the first to the last
        }
        void expect(bool holds, std::string_view what, const char* id = "hdf5.format") const {
            parser.require_at(start, holds, id, what);
        }
        void signature(std::string_view letters) {
            const Bytes found = take(letters.size());
            expect(std::ranges::equal(found, as_bytes(letters)), "the signature " + std::string(letters));
        }
        // Bytes `start` to here are covered by the checksum that follows.
        void checksum() {
            const Bytes covered = parser.file.bytes.subspan(start, at - start);
            expect(number(4) == lookup3(covered), "data that match their checksum", "hdf5.checksum");
        }
        // Returns the next n bytes, the last before the checksum, which is verified.
        Cursor checked(uint64_t n) {
            Cursor next = *this;
            take(n);
            next.end = at;
            checksum();
            return next;
        }
    };
    // Without `size` the end is that of the file.
    Cursor cursor(uint64_t address, std::optional<uint64_t> size = {}) {
        require_inside(address, size.value_or(0));
        return {*this, address, size ? address + *size : file.bytes.size()};
    }
    // Returns a cursor behind the letters and the byte (mostly a version) with which a structure begins.
    Cursor structure(uint64_t address, const std::string& letters, uint64_t byte, std::optional<uint64_t> size = {}) {
        Cursor c = cursor(address, size);
        c.signature(letters);
        c.expect(c.number(1) == byte, "the byte " + std::to_string(byte) + " after " + letters);
        return c;
    }

    // SPEC II.A.
    //   version 0, 1   signature 8 | version | 4 versions | 8, 8: widths | .. | base 8 | free space 8 | end of file 8 |
    //                  driver 8 | root group: name 8, object header 8
    //   version 2, 3   signature 8 | version | 8, 8 | flags | base 8 | extension 8 | end of file 8 | root 8 | sum
    void superblock() {
        const Bytes all = file.bytes;
        const auto peek = [&](size_t at) { return std::string(all.begin() + at, all.begin() + at + 8); };
        const std::optional<size_t> place = superblock_place(all.size(), peek);
        require(place.has_value(), "hdf5.format", file.path, ": is not an HDF5 file (it has no superblock)");
        file.bytes = all.subspan(*place);
        Cursor c = cursor(8);
        c.start = 0;
        const uint64_t version = c.number(1);
        c.expect(version <= 3, "a superblock of version 0 to 3");
        const auto [versions, offsets, lengths] = c.fields(version < 2 ? 4 : 0, 1, 1);
        c.expect(offsets == 8 && lengths == 8, "offsets and lengths of 8 bytes", "hdf5.unsupported");
        const int before = version == 0 ? 9 : version == 1 ? 13 : 1;  // bytes up to the base address
        const auto [flags, base_address, more, end, driver, root] = c.fields(before, 8, 8, 8, version < 2 ? 16 : 0, 8);
        require(end <= all.size(), "hdf5.truncated", file.path, ": has ", all.size(), " bytes, its superblock says ",
                end, "; the file was cut off");
        if (version >= 2) c.checksum();
        objects.push_back({"", root});
        for (; !objects.empty(); objects.pop_front()) visit(objects.front().first, objects.front().second);
        std::ranges::sort(file.datasets, {}, &Hdf5Dataset::path);
    }

    // SPEC IV.A.1: object headers.
    //   version 1   1 | .. | count 2 | references 4 | size 4 | .. 4 | messages: type 2, size 2, flags 1, .. 3, data
    //   version 2   OHDR 2 | flags | .. | size 1..8 | messages: type 1, size 2, flags 1, [order 2], data | sum
    // A message of type 0x10 says where more of them are (IV.A.2.q): address 8, length 8.
    struct Message {
        uint64_t type, flags;
        Cursor data;
    };

    std::vector<Message> messages(uint64_t address) {
        std::vector<Message> out;
        std::vector<Cursor> blocks;
        uint64_t type_size = 2, rest = 3;  // bytes of the type, and between flags and data
        Cursor first = cursor(address);
        const bool old = cursor(address, 1).number(1) == 1;
        if (old) {
            const auto [counts, size, reserved] = first.fields(8, 4, 4);
            blocks.push_back(cursor(first.at, size));
        } else {
            Cursor c = structure(address, "OHDR", 2);
            const uint64_t flags = c.number(1);
            c.take(((flags & 32) != 0 ? 16 : 0) + ((flags & 16) != 0 ? 4 : 0));
            type_size = 1;
            rest = (flags & 4) != 0 ? 2 : 0;
            blocks.push_back(c.checked(c.number(uint64_t{1} << (flags & 3))));
        }
        for (size_t b = 0; b < blocks.size(); ++b) {
            Cursor block = blocks[b];
            while (block.end - block.at >= type_size + 3 + rest) {
                const auto [type, size, flags, unused] = block.fields(type_size, 2, 1, rest);
                Cursor data = cursor(block.at, size);
                block.expect(size <= block.end - block.at, "a message within its block");
                block.at += size;
                if (type == 0x10)
                    blocks.push_back(continuation(data, old));
                else if (type != 0)
                    out.push_back({type, flags, data});
            }
        }
        return out;
    }

    Cursor continuation(Cursor message, bool old) {
        const auto [address, length] = message.fields(8, 8);
        Cursor block = cursor(address, length);
        block.expect(length >= 8, "a continuation block of at least 8 bytes");
        if (old) return block;
        block.signature("OCHK");
        return block.checked(length - 8);
    }

    struct Link {
        std::string name;
        uint64_t address;               // of a hard link
        std::optional<std::string> to;  // of a soft one: a path, from the root group if it begins with a slash
    };
    using Links = std::vector<Link>;

    // Reads the data set or group of this path. What a group holds is visited later, so that of several paths to a
    // group the shortest becomes its own, and the others are links to it. A named type is passed over, as is what lies
    // so deep that its path has more than 4096 bytes.
    void visit(const std::string& path, uint64_t address) {
        object = path.empty() ? "root group" : json_string(path);
        const std::vector<Message> header = messages(address);
        const auto has = [&](uint64_t type) { return std::ranges::find(header, type, &Message::type) != header.end(); };
        if (has(0x08)) return dataset(path, header);
        if (!has(0x11) && !has(0x02)) return;
        const auto [known, first_visit] = groups.emplace(address, path);
        if (!first_visit) file.links[path] = known->second;
        if (!first_visit) return;
        file.groups.insert(path);
        Links links;
        for (const Message& message : header) {
            if (message.type == 0x11) symbol_table(links, message.data);
            if (message.type == 0x02) dense_links(links, message.data);
            if (message.type == 0x06) link_message(links, message.data);
            if (message.type == 0x0C && path.empty() && (message.flags & 2) == 0) attribute(message.data);
        }
        for (const auto& [name, child, to] : links) {
            const bool plain = !name.empty() && name.find('/') == std::string::npos;
            require_at(address, plain, "hdf5.format", "names without slashes");
            const std::string parent = path.empty() ? "" : path + "/";
            if (parent.size() + name.size() > 4096) continue;
            charge(address, 2 * parent.size() + name.size() + (to ? to->size() : 0));
            if (to)
                file.links[parent + name] = plain_path(to->starts_with('/') ? *to : parent + *to);
            else
                objects.push_back({parent + name, child});
        }
    }

    // Returns a path without the empty parts and the dots that mean nothing.
    static std::string plain_path(const std::string& path) {
        std::string plain;
        for (const auto part : std::views::split(path, '/')) {
            const std::string name(part.begin(), part.end());
            if (!name.empty() && name != ".") plain += (plain.empty() ? "" : "/") + name;
        }
        return plain;
    }

    // SPEC IV.A.2.m: version | flags | sizes of name, type and space 2, 2, 2 | [character set] | the three (in version
    // 1 each filled up to a multiple of 8) | value
    void attribute(Cursor c) {
        const auto [version, flags, name_size, type_size, space_size] = c.fields(1, 1, 2, 2, 2);
        c.expect(version >= 1 && version <= 3, "an attribute of version 1 to 3");
        c.take(version == 3 ? 1 : 0);
        const auto part = [&](uint64_t size) {
            Cursor whole = cursor(c.at, size);
            c.take(version == 1 ? 8 * quotient(size, 8) : size);
            return whole;
        };
        const Cursor name_at = part(name_size), type = part(type_size), space = part(space_size);
        if (version > 1 && (flags & 3) != 0) return;  // type or space are shared with other objects
        Grid value;
        datatype(value, type);
        dataspace(value, space);
        if (value.element.kind == Hdf5Element::other || value.element.kind == Hdf5Element::text) return;
        if (value.elements != 1) return;
        file.attributes[text_at(name_at)] = element_value<double>(value.element, c.take(value.element.size).data());
    }

    // Returns the text from here to the NUL that ends it.
    std::string text_at(Cursor c) {
        const Bytes rest = file.bytes.subspan(c.at, c.end - c.at);
        const auto end = std::ranges::find(rest, 0);
        c.expect(end != rest.end(), "a text that ends");
        charge(c.at, static_cast<size_t>(end - rest.begin()));
        return {rest.begin(), end};
    }

    // SPEC III.A.1: a version-1 B-tree. Calls leaf(key, child) in order; only `leaf` knows what a key means.
    //   TREE | type | level | entries 2 | siblings 8, 8 | key 0 | child 0: address 8 | key 1 | child 1 | ...
    static constexpr uint64_t any_level = 256;
    void b_tree_1(uint64_t address, uint64_t type, uint64_t key_size, const auto& leaf, uint64_t level = any_level) {
        Cursor c = structure(address, "TREE", type);
        const auto [depth, entries, siblings] = c.fields(1, 2, 16);
        c.expect(level == any_level || depth == level, "a node one level below the last");
        for (uint64_t i = 0; i < entries; ++i) {
            const Cursor key = cursor(c.at, key_size);
            c.take(key_size);
            const uint64_t child = c.number(8);
            if (depth == 0)
                leaf(key, child);
            else
                b_tree_1(child, type, key_size, leaf, depth - 1);
        }
    }

    // SPEC IV.A.2.r: the message of an old group.
    //   message      B-tree 8 | local heap 8
    //   local heap   HEAP 0 | .. 3 | size 8 | free list 8 | names 8, each ended by a NUL                 (III.D)
    //   symbol node  SNOD 1 | .. | count 2 | entries: name in the heap 8, header 8, kind 4, .. 4, a soft link's path in
    //                the heap 4, .. 12                                                                   (III.B, III.C)
    void symbol_table(Links& links, Cursor message) {
        const auto [tree, heap_address] = message.fields(8, 8);
        Cursor heap = structure(heap_address, "HEAP", 0);
        const auto [reserved, size, free, segment] = heap.fields(3, 8, 8, 8);
        Cursor names = cursor(segment, size);
        names.take(size);
        const auto text = [&](uint64_t at) {
            names.expect(at < names.end - names.start, "a text within the heap");
            return text_at(cursor(names.start + at, names.end - names.start - at));
        };
        b_tree_1(tree, 0, 8, [&](Cursor, uint64_t node) {
            Cursor c = structure(node, "SNOD", 1);
            const auto [unused, count] = c.fields(1, 2);
            for (uint64_t n = 0; n < count; ++n) {
                const auto [name, header, kind, reserved_4, target, scratch] = c.fields(8, 8, 4, 4, 4, 12);
                links.push_back({text(name), header, {}});
                if (kind == 2) links.back().to = text(target);  // a soft link
            }
        });
    }

    // SPEC IV.A.2.g: 1 | flags | [type] | [order 8] | [character set] | length of the name 1..8 | name, then by type
    //   0, hard: address 8 | 1, soft: length 2, path | 64, external: length 2, flags 1, file NUL, path NUL
    void link_message(Links& links, Cursor c) {
        const auto [version, flags] = c.fields(1, 1);
        c.expect(version == 1, "a link message of version 1");
        const uint64_t type = (flags & 8) != 0 ? c.number(1) : 0;
        c.take(((flags & 4) != 0 ? 8 : 0) + ((flags & 16) != 0 ? 1 : 0));
        const Bytes name = c.take(c.number(uint64_t{1} << (flags & 3)));
        links.push_back({std::string(name.begin(), name.end()), type == 0 ? c.number(8) : 0, {}});
        if (type == 0) return;
        const Bytes value = c.take(c.number(2));
        std::string to(value.begin(), value.end());
        std::ranges::replace(to, '\0', ' ');
        links.back().to = type == 1 ? to : "/another file:" + to.substr(0, to.find_last_not_of(' ') + 1);
    }

    // SPEC III.A.2: a version-2 B-tree. Calls record(cursor) for each record.
    //   BTHD 0 | type | node size 4 | record size 2 | depth 2 | percents 1, 1 | root 8 | its records 2 | all 8 | sum
    //   BTLF 0 or BTIN 0 | type | records | in BTIN pointers, one more than records | sum
    //   pointer   child 8 | its records | records of its subtree; each in as few bytes as its greatest value needs
    void b_tree_2(uint64_t address, uint64_t type, const auto& record) {
        Cursor c = structure(address, "BTHD", 0);
        c.expect(c.number(1) == type, "a B-tree of type " + std::to_string(type));
        const auto [node_size, record_size, depth, percents, root, count, all] = c.fields(4, 2, 2, 2, 8, 2, 8);
        c.checksum();
        c.expect(record_size > 0 && node_size >= 10 + record_size && depth <= 32, "room for records in a node");
        const auto width = [](uint64_t greatest) { return log2(greatest) / 8 + 1; };
        Shape most, subtree_width;  // by level: records in a node; bytes of a subtree's count
        uint64_t below = 0;         // the most records in a subtree
        for (uint64_t level = 0; level <= depth; ++level) {
            const uint64_t pointer = level == 0 ? 0 : 8 + width(most[0]) + subtree_width.back();
            c.expect(node_size >= 10 + pointer, "room for a pointer in a node");
            most.push_back((node_size - 10 - pointer) / (record_size + pointer));
            below = product(most.back() + 1, below, address) + most.back();
            subtree_width.push_back(level == 0 ? 0 : width(below));
        }
        const auto node = [&](const auto& self, uint64_t at, uint64_t records, uint64_t level) -> void {
            Cursor n = structure(at, level == 0 ? "BTLF" : "BTIN", 0);
            n.expect(n.number(1) == type && records <= most[level], "a node of the B-tree's type and size");
            const uint64_t pointers = level == 0 ? 0 : records + 1, skipped = level == 0 ? 0 : subtree_width[level - 1];
            Cursor body = n.checked(records * record_size + pointers * (8 + width(most[0]) + skipped));
            for (uint64_t i = 0; i < records; ++i) {
                record(cursor(body.at, record_size));
                body.take(record_size);
            }
            for (uint64_t i = 0; i < pointers; ++i) {
                const auto [child, child_records, subtree] = body.fields(8, width(most[0]), skipped);
                self(self, child, child_records, level - 1);
            }
        };
        if (root != undefined_address) node(node, root, count, depth);
    }

    // SPEC III.G: a fractal heap holds objects, found by their offset in a space of its own, in a doubling table: rows
    // of `width` blocks, two rows of the smallest size, then each row doubles. Beyond `direct_rows` a block is again
    // such a table (an indirect block).
    //   FRHP 0 | ID length 2 | filters 2 | flags | largest object 4 | .. 96 | width 2 | smallest block 8 |
    //            largest direct block 8 | bits of an offset 2 | .. 2 | root block 8 | its rows 2 | .. | sum
    //   FHDB 0 | heap 8 | offset | [sum] | objects           FHIB 0 | heap 8 | offset | addresses of blocks | sum
    struct Heap {
        uint64_t offset_width, length_width;                            // bytes of each in a heap ID
        std::map<uint64_t, std::pair<uint64_t, uint64_t>> blocks = {};  // offset -> address, size in the file
    };

    Heap fractal_heap(uint64_t address) {
        Cursor c = structure(address, "FRHP", 0);
        const auto [id_length, filters, flags, most, statistics] = c.fields(2, 2, 1, 4, 96);
        c.expect(filters == 0, "a heap without filters", "hdf5.unsupported");
        const auto [width, smallest, largest, bits, first_rows, root, root_rows] = c.fields(2, 8, 8, 2, 2, 8, 2);
        c.checksum();
        const bool powers = std::has_single_bit(width) && std::has_single_bit(smallest) && std::has_single_bit(largest);
        const bool sizes = smallest <= largest && largest <= uint64_t{1} << 32 && bits <= 64 && root_rows <= 64;
        c.expect(powers && sizes && most > 0, "a doubling table of powers of two");
        const uint64_t direct_rows = log2(largest) - log2(smallest) + 2;
        Heap heap{(bits + 7) / 8, log2(std::min(most, largest)) / 8 + 1};
        const auto block_of = [&](uint64_t at, const char* letters, std::optional<uint64_t> size, uint64_t offset) {
            Cursor block = structure(at, letters, 0, size);
            const bool same = block.number(8) == address && block.number(heap.offset_width) == offset;
            block.expect(same, text_of("a block of the heap at ", address, ", offset ", offset));
            return block;
        };
        const auto direct = [&](uint64_t at, uint64_t size, uint64_t offset) {
            Cursor block = block_of(at, "FHDB", size, offset);
            const Bytes all = cursor(at, size).take(size);
            if ((flags & 2) != 0) {  // direct blocks have a checksum, which is taken with zeros in its own place
                const uint64_t stored = block.number(4);
                std::vector<uint8_t> covered(all.begin(), all.end());
                std::fill_n(&covered[block.at - 4 - at], 4, uint8_t{0});
                block.expect(stored == lookup3(covered), "data that match their checksum", "hdf5.checksum");
            }
            heap.blocks[offset] = {at, size};
        };
        const auto indirect = [&](const auto& self, uint64_t at, uint64_t rows, uint64_t offset) -> void {
            Cursor block = block_of(at, "FHIB", {}, offset);
            Cursor children = block.checked(rows * width * 8);
            for (uint64_t row = 0; row < rows; ++row) {
                const uint64_t power = log2(smallest) + (row == 0 ? 0 : row - 1);
                block.expect(power < 64, "a heap below 2^64 bytes");
                for (uint64_t column = 0; column < width; ++column, offset += uint64_t{1} << power) {
                    const uint64_t child = children.number(8);
                    if (child == undefined_address) continue;
                    block.expect(row < direct_rows || row >= log2(width), "a table smaller than the one it is in");
                    if (row < direct_rows)
                        direct(child, uint64_t{1} << power, offset);
                    else
                        self(self, child, row - log2(width), offset);
                }
            }
        };
        if (root != undefined_address && root_rows == 0) direct(root, smallest, 0);
        if (root != undefined_address && root_rows > 0) indirect(indirect, root, root_rows, 0);
        return heap;
    }

    // SPEC IV.A.2.c: many links lie in a heap, as the same messages, and a B-tree of type 5 has their places.
    //   message   0 | flags | [order 8] | heap 8 | B-tree 8 | ..         record   hash of the name 4 | heap ID
    //   heap ID   kind in bits 4 to 7 (0: in a block) | offset | length
    void dense_links(Links& links, Cursor message) {
        const auto [version, flags] = message.fields(1, 1);
        message.expect(version == 0, "a link information message of version 0");
        const auto [order, heap_address, tree] = message.fields((flags & 1) != 0 ? 8 : 0, 8, 8);
        if (heap_address == undefined_address) return;
        const Heap heap = fractal_heap(heap_address);
        b_tree_2(tree, 5, [&](Cursor c) {
            const auto [hash, kind, offset, length] = c.fields(4, 1, heap.offset_width, heap.length_width);
            c.expect((kind & 0xF0) == 0, "a link shorter than 4096 bytes", "hdf5.unsupported");
            auto block = heap.blocks.upper_bound(offset);
            c.expect(block != heap.blocks.begin(), "a link within the heap");
            --block;
            const auto& [address, size] = block->second;
            const uint64_t inside = offset - block->first;
            c.expect(inside < size && length <= size - inside, "a link within a block of the heap");
            link_message(links, cursor(address + inside, length));
        });
    }

    // A data set in the making, and what is read of its header but not kept.
    struct Grid : Hdf5Dataset {
        Shape most;                // the extents to which the data set may grow; ~0: without limit
        Shape counts;              // chunks in each dimension
        uint64_t all = 1;          // chunks
        bool whole_edges = false;  // chunks that hang over the edge are not filtered
        // Arrays number the chunks row-major, by `most`; if one dimension is unlimited, it counts slowest, whichever it
        // is (H5D__earray_idx in HDF5; SPEC is silent).
        std::vector<size_t> order;                          // dimensions, slowest first
        Shape step;                                         // [k]: from one chunk to the next in dimension order[k]
        uint64_t index = 0, entry_size = 0, page_size = 0;  // an array's header; bytes of an entry; entries of a page
    };

    void dataset(const std::string& path, const std::vector<Message>& header) {
        Grid g;
        g.path = path;
        const auto each = [&](uint64_t type, const char* part, const auto& read) {
            for (const Message& message : header) {
                if (message.type != type) continue;
                if ((message.flags & 2) == 0)
                    read(message.data);
                else if (g.unsupported.empty())
                    g.unsupported = text_of("its ", part, " is shared with other objects (a committed type, or shared ",
                                            "messages); write the data anew, with h5py as create_dataset(NAME, "
                                            "data=OLD[NAME][:])");
            }
        };
        each(0x01, "shape", [&](Cursor c) { dataspace(g, c); });
        each(0x03, "type", [&](Cursor c) { datatype(g, c); });
        each(0x07, "list of files", [&](Cursor) { g.unsupported = "its data are in another file"; });
        each(0x0B, "list of filters", [&](Cursor c) { filter_pipeline(g, c); });
        if (g.element.kind == Hdf5Element::other && g.unsupported.empty())
            g.unsupported = "elements of type " + g.type + " are not supported";
        each(0x05, "fill value", [&](Cursor c) { fill_value(g, c); });
        each(0x08, "layout", [&](Cursor c) {
            charge(c.start, sizeof(Hdf5Dataset) + path.size());
            c.expect(g.chunk_bytes == 0, "one layout message");
            if (g.unsupported.empty()) layout(g, c);
        });
        file.datasets.push_back(std::move(g));
    }

    // SPEC IV.A.2.b: version | rank | flags | kind | [.. 4] | extents 8 each | [largest extents 8 each]
    void dataspace(Grid& g, Cursor c) {
        const auto [version, rank, flags, kind] = c.fields(1, 1, 1, 1);
        c.expect((version == 1 || version == 2) && rank <= 32, "a data space of version 1 or 2, up to 32 dimensions");
        if (version == 1) c.take(4);
        g.shape.resize(rank);
        for (uint64_t& extent : g.shape) extent = c.number(8);
        g.most = g.shape;
        for (uint64_t& extent : g.most) extent = (flags & 1) != 0 ? c.number(8) : extent;
        if (version == 2 && kind == 2) g.shape = g.most = {0};  // no elements, no shape
        g.elements = std::ranges::count(g.shape, 0) == 0 ? 1 : 0;
        if (g.elements == 0) return;
        for (size_t k = 0; k < rank; ++k) {
            g.elements = product(g.elements, g.shape[k], c.at);
            c.expect(g.shape[k] <= g.most[k], "extents that are not above the largest allowed");
        }
    }

    // SPEC IV.A.2.d: version, class 4 bits each | flags 3 | size 4 | properties
    //   class 0, integers      flags: 1 big-endian, 8 signed     properties: first bit 2, bits 2
    //   class 1, floats        flags: 1 big-endian, 0x20 hidden bit, sign's place from bit 8 on
    //                          properties: first bit 2, bits 2, exponent: place, bits; mantissa: place, bits; bias 4
    //   class 3, strings       flags: padding
    //   class 4, bit fields    flags: 1 big-endian   properties: first bit 2, bits 2; PyTables' bool is of one byte
    //   class 8, enumerations  flags: members     properties: integer type, names, values; h5py's bool is FALSE, TRUE
    void datatype(Hdf5Dataset& d, Cursor c) {
        const auto [head, flags, size] = c.fields(1, 3, 4);
        const uint64_t type = head & 15, version = head >> 4;
        const std::string bits = std::to_string(8 * size);
        c.expect(version >= 1 && version <= 5 && size > 0, "a data type of version 1 to 5");
        d.element = {.size = size};
        d.type = type == 6 ? "compound" : type == 9 ? "variable length" : "class " + std::to_string(type);
        if (type == 1) d.type = "floating point of " + std::to_string(size) + " bytes";
        if (type == 0) {
            const auto [first, precision] = c.fields(2, 2);
            if (size > 8 || first != 0 || precision != 8 * size) return;
            const bool has_sign = (flags & 8) != 0;
            d.element.kind = has_sign ? Hdf5Element::signed_integer : Hdf5Element::unsigned_integer;
            d.type = (has_sign ? "int" : "uint") + bits;
        } else if (type == 1) {
            constexpr std::array<uint8_t, 12> half = {0, 0, 16, 0, 10, 5, 0, 10, 15, 0, 0, 0};
            constexpr std::array<uint8_t, 12> single = {0, 0, 32, 0, 23, 8, 0, 23, 127, 0, 0, 0};
            constexpr std::array<uint8_t, 12> twice = {0, 0, 64, 0, 52, 11, 0, 52, 255, 3, 0, 0};
            const bool known = size == 2 || size == 4 || size == 8;
            const bool ieee = known && std::ranges::equal(c.take(12), size == 2 ? half : size == 4 ? single : twice);
            if (!ieee || (flags & 0x70) != 0x20 || flags >> 8 != 8 * size - 1) return;
            d.element.kind = Hdf5Element::floating;
            d.type = "float" + bits;
        } else if (type == 3) {
            if ((flags & 15) > 2) return;
            d.element.kind = Hdf5Element::text;
            d.type = "text of " + std::to_string(size) + " bytes";
        } else if (type == 4) {
            const auto [first, precision] = c.fields(2, 2);
            if (size != 1 || first != 0 || precision != 8) return;
            d.element.kind = Hdf5Element::unsigned_integer;
            d.type = "bit field of 8";
        } else if (type == 8) {
            Cursor base = c;
            if ((base.number(1) & 15) != 0) return;
            datatype(d, c);
            c.expect(d.element.size == size, "an enumeration of the size of its integers");
            c.take(12);  // the integer type
            const Bytes names = c.take(std::min<uint64_t>(6, c.end - c.at));
            const bool boolean = flags == 2 && size == 1 && std::ranges::equal(names, as_bytes({"FALSE", 6}));
            if (d.element.kind != Hdf5Element::other) d.type = boolean ? "bool" : "enumeration " + d.type;
            return;
        }
        d.element.big_endian = type < 2 && (flags & 1) != 0 && size > 1;
        if (d.element.big_endian) d.type += ", big-endian";
    }

    // SPEC IV.A.2.f. Version 1, 2: version | when to write 2 | defined? | size 4 | value. Version 3: flags for the two.
    void fill_value(Hdf5Dataset& d, Cursor c) {
        const uint64_t version = c.number(1);
        c.expect(version >= 1 && version <= 3, "a fill value of version 1 to 3");
        c.take(version == 3 ? 0 : 2);
        const uint64_t flags = c.number(1);
        const bool defined = version == 3 ? (flags & 32) != 0 : version == 1 || flags != 0;
        const uint64_t size = defined ? c.number(4) : 0;
        if (size == 0 || !d.unsupported.empty()) return;
        c.expect(size == d.element.size, "a fill value of the data's type");
        d.fill = c.take(size);
    }

    // SPEC IV.A.2.l: version | count | [.. 6] | filters: ID 2, [length of the name 2], flags 2, values 2, name, values
    void filter_pipeline(Hdf5Dataset& d, Cursor c) {
        const auto [version, count] = c.fields(1, 1);
        d.filters.clear();
        c.expect((version == 1 || version == 2) && count <= 32, "a list of up to 32 filters, version 1 or 2");
        if (version == 1) c.take(6);
        for (uint64_t i = 0; i < count; ++i) {
            const uint64_t id = c.number(2), name = version == 1 || id >= 256 ? c.number(2) : 0;
            const auto [flags, values] = c.fields(2, 2);
            c.take(version == 1 ? quotient(name, 8) * 8 : name);
            c.take(4 * (version == 1 ? quotient(values, 2) * 2 : values));
            const auto other = std::ranges::find(other_filters, id, &std::pair<uint64_t, const char*>::first);
            const std::string known_as = other == std::end(other_filters) ? "" : text_of(" (", other->second, ")");
            if ((id < 1 || id > 3) && id != 32000)
                d.unsupported = "filter " + std::to_string(id) + known_as + " is not supported" + repack_advice;
            d.filters.push_back(static_cast<Hdf5Filter>(id));
        }
        if (std::ranges::count(d.filters, Hdf5Filter::deflate) + std::ranges::count(d.filters, Hdf5Filter::lzf) > 1)
            d.unsupported = std::string("it is compressed twice") + repack_advice;
    }

    // SPEC IV.A.2.i, versions 3 and 4. HDF5 2.0.0 knows 5, but writes 4 under libver latest and v200 too; 5 differs in
    // the width of a size in an index alone, and the index itself tells that width.
    //   class 0, compact      size 2 | data
    //   class 1, contiguous   address 8 | size 8
    //   class 2, version 3    rank + 1 | B-tree 8 | chunk extents 4 each, then the element's size
    //            version 4    flags | rank + 1 | width | chunk extents, then the element's size | index type 1..5 |
    //                         what the index needs | address 8
    void layout(Grid& g, Cursor c) {
        const auto [version, kind] = c.fields(1, 1);
        if (version < 3 || version > 5 || kind > 2) {
            g.unsupported = "its layout is of version " + std::to_string(version) + ", class " + std::to_string(kind);
            if (kind == 3) g.unsupported = "its layout is virtual: the data are in other data sets or files";
            g.unsupported += repack_advice;
            return;
        }
        const uint64_t total = product(g.elements, g.element.size, c.at);
        const uint64_t as_floats = product(g.elements, std::max<uint64_t>(g.element.size, sizeof(float)), c.at);
        promised = bounded(promised + bounded(as_floats, c), c);
        if (kind == 2) return chunked(g, c, version);
        g.filters.clear();
        g.chunk = g.shape;
        g.chunk_bytes = total;
        const auto [elsewhere, size] = c.fields(kind == 0 ? 0 : 8, kind == 0 ? 2 : 8);
        const uint64_t address = kind == 0 ? c.at : elsewhere;
        c.expect(kind != 0 || size <= c.end - c.at, "compact data within their message");
        if (total == 0 || address == undefined_address) return;
        c.expect(size >= total, std::to_string(total) + " bytes of data");
        add(g, {address, total}, c.start);
    }

    // Returns `bytes`, if that is in proportion to the file: deflate shrinks at most 1032-fold, and data that are all
    // fill value take nothing. Above 16 GiB it is no more than uncompressed bytes become as floats. Errors:
    // hdf5.too_large.
    uint64_t bounded(uint64_t bytes, const Cursor& c) const {
        const uint64_t stored = file.bytes.size(), most = uint64_t{1} << 34;
        const uint64_t limit = std::max(4 * stored, std::min(most, 1040 * stored + (1 << 26)));
        c.expect(bytes <= limit, "at most " + std::to_string(limit) + " bytes in a file so small", "hdf5.too_large");
        return bytes;
    }

    // The indexes of chunks (SPEC VII; III.A.1, node type 1; III.A.2, types 10 and 11).
    //   B-tree 1   a key: the chunk's size 4, skipped filters 4, its first element 8 each
    //   B-tree 2   a record: an entry (see index_entry), then the chunk's place 8 each
    void chunked(Grid& g, Cursor c, uint64_t version) {
        const size_t rank = g.shape.size();
        const uint64_t flags = version == 3 ? 0 : c.number(1), extents = c.number(1);
        const uint64_t tree = version == 3 ? c.number(8) : 0, width = version == 3 ? 4 : c.number(1);
        c.expect(extents == rank + 1 && width >= 1 && width <= 8, "chunks of as many dimensions as the data");
        g.chunk_bytes = g.element.size;
        for (size_t k = 0; k < rank; ++k) {
            g.chunk.push_back(c.number(width));
            c.expect(g.chunk[k] > 0, "chunks that are not empty");
            g.chunk_bytes = product(g.chunk_bytes, g.chunk[k], c.at);
            g.counts.push_back(quotient(g.shape[k], g.chunk[k]));
            g.all = g.elements == 0 ? 0 : product(g.all, g.counts[k], c.at);
        }
        c.expect(c.number(width) == g.element.size, "chunks of the data's elements");
        bounded(product(g.all, g.chunk_bytes, c.at), c);
        g.whole_edges = (flags & 1) != 0;
        if (g.elements == 0) return;
        if (version == 3 && tree == undefined_address) return;
        if (version == 3)
            return b_tree_1(tree, 1, 16 + 8 * rank, [&](Cursor key, uint64_t address) {
                const auto [size, skipped] = key.fields(4, 4);
                Hdf5Chunk chunk{address, size, static_cast<uint32_t>(skipped)};
                for (size_t k = 0; k < rank; ++k) {
                    const uint64_t first = key.number(8);
                    key.expect(first % g.chunk[k] == 0, "a chunk that begins at a multiple of its extents");
                    chunk.place.push_back(first / g.chunk[k]);
                }
                add(g, chunk, key.start);
            });
        const uint64_t index = c.number(1);
        c.expect(index >= 1 && index <= 5, "a chunk index of type 1 to 5");
        const bool alone = index == 1 && (flags & 2) != 0;  // a filtered chunk; other indexes repeat their parameters
        const auto [stored, skipped] = c.fields(alone ? 8 : 0, alone ? 4 : 0);
        constexpr uint64_t parameters[] = {0, 0, 0, 1, 5, 6};  // bytes, by index type
        c.take(parameters[index]);
        const uint64_t address = c.number(8);
        if (address == undefined_address) return;
        const Hdf5Chunk single{address, alone ? stored : g.chunk_bytes, static_cast<uint32_t>(skipped), Shape(rank)};
        if (index == 1) return add(g, single, c.start);
        if (index == 5)
            return b_tree_2(address, g.filters.empty() ? 10 : 11, [&](Cursor record) {
                Hdf5Chunk chunk = index_entry(g, record, record.end - record.at - 8 * rank);
                for (size_t k = 0; k < rank; ++k) chunk.place.push_back(record.number(8));
                add(g, chunk, record.start);
            });
        for (size_t k = 0; k < rank; ++k)
            g.order.insert(g.most[k] == ~uint64_t{0} ? g.order.begin() : g.order.end(), k);
        g.step.assign(rank, 1);
        for (size_t k = rank; k-- > 1;)
            g.step[k - 1] = product(g.step[k], quotient(g.most[g.order[k]], g.chunk[g.order[k]]), c.at);
        g.index = address;
        if (index == 2) implicit_index(g);
        if (index == 3) fixed_array(g);
        if (index == 4) extensible_array(g);
    }

    // Chunks beyond the edge are left over from when the data set was larger.
    void add(Grid& g, Hdf5Chunk chunk, uint64_t offset) {
        if (chunk.address == undefined_address) return;
        bool partial = false;
        for (size_t k = 0; k < chunk.place.size(); ++k) {
            if (chunk.place[k] >= g.counts[k]) return;
            partial = partial || g.shape[k] - chunk.place[k] * g.chunk[k] < g.chunk[k];
        }
        if (g.whole_edges && partial) chunk.skipped = ~0u;
        require_at(offset, g.chunks.size() < g.all, "hdf5.format", "each chunk once");
        require_inside(chunk.address, chunk.size);
        charge(offset, sizeof chunk + chunk.place.size() * sizeof chunk.place[0]);
        g.chunks.push_back(chunk);
        g.stored += chunk.size;
    }

    // An entry of an index has `size` bytes: address 8, and with filters the chunk's size 1..8 and those skipped 4.
    static Hdf5Chunk index_entry(const Grid& g, Cursor& c, uint64_t size) {
        const bool filtered = !g.filters.empty();
        c.expect(filtered ? size > 12 && size <= 20 : size == 8, "entries of 8 bytes, or with filters of 13 to 20");
        const uint64_t address = c.number(8), stored = filtered ? c.number(size - 12) : g.chunk_bytes;
        return {address, stored, static_cast<uint32_t>(filtered ? c.number(4) : 0)};
    }

    // Returns the place of the chunk that has this number in an array.
    static Shape place_of(const Grid& g, uint64_t number) {
        Shape place(g.order.size());
        for (size_t k = 0; k < place.size(); number %= g.step[k++]) place[g.order[k]] = number / g.step[k];
        return place;
    }

    // SPEC VII.B: chunk after chunk, without an index.
    void implicit_index(Grid& g) {
        uint64_t last = 0;  // number of the last chunk of the data set
        for (size_t k = 0; k < g.step.size(); ++k) {
            const uint64_t more = product(g.counts[g.order[k]] - 1, g.step[k], g.index);
            require_at(g.index, more < ~last, "hdf5.too_large", "numbers of chunks of at most 64 bits");
            last += more;
        }
        require_inside(g.index, product(last + 1, g.chunk_bytes, g.index));
        for (uint64_t number = 0; number <= last; ++number)
            add(g, {g.index + number * g.chunk_bytes, g.chunk_bytes, 0, place_of(g, number)}, g.index);
    }

    // The index is an array of entries, numbered from 0. Its header and blocks (SPEC VII.C and D) begin alike:
    //   letters 0 | filtered? | in blocks: the header's address 8 | ...
    // and hold `count` entries from number `first` on, in pages (each with a checksum) if they are more than a page.
    Cursor array_block(const Grid& g, uint64_t address, const std::string& letters) {
        Cursor c = structure(address, letters, 0);
        c.expect(c.number(1) == (g.filters.empty() ? 0 : 1), "an index of chunks filtered as the data set says");
        const bool same = address == g.index || c.number(8) == g.index;
        c.expect(same, "a block of the index at " + std::to_string(g.index));
        return c;
    }

    void entries(Grid& g, Cursor& c, uint64_t first, uint64_t count) {
        for (uint64_t number = first; number < first + count; ++number) {
            Hdf5Chunk chunk = index_entry(g, c, g.entry_size);
            chunk.place = place_of(g, number);
            add(g, chunk, c.start);
        }
    }

    // Reads a data block of `count` entries. `written`: a bit for each page, the highest of a byte first; page 0 has
    // bit number `bit`. These bits are in a secondary block, or, if there is none, at the block's beginning.
    void data_block(Grid& g, const std::string& letters, uint64_t address, uint64_t prefix, uint64_t first,
                    uint64_t count, Bytes written, uint64_t bit) {
        Cursor c = array_block(g, address, letters);
        const bool paged = count > g.page_size;
        Cursor body = c.checked(prefix + (paged ? 0 : product(g.entry_size, count, address)));
        const Bytes before = body.take(prefix);
        if (!paged) return entries(g, body, first, count);
        if (written.empty()) written = before;
        uint64_t page = c.at;
        for (uint64_t done = 0; done < count; ++bit) {
            const uint64_t here = std::min(g.page_size, count - done), bytes_here = product(here, g.entry_size, page);
            if ((written[bit / 8] << (bit % 8) & 0x80) != 0) {
                Cursor entry = cursor(page).checked(bytes_here);
                entries(g, entry, first + done, here);
            }
            page += bytes_here + 4;
            done += here;
        }
    }

    // SPEC VII.C.
    //   FAHD ..  entry size 1 | bits of a page's entries 1 | entries 8 | block 8 | sum
    //   FADB ..  entries | sum     or, with pages     bits of the pages | sum | pages
    void fixed_array(Grid& g) {
        Cursor c = array_block(g, g.index, "FAHD");
        const auto [size, page_bits, count, block] = c.fields(1, 1, 8, 8);
        c.checksum();
        c.expect(page_bits < 64, "pages below 2^64 entries");
        if (block == undefined_address) return;
        g.entry_size = size;
        g.page_size = uint64_t{1} << page_bits;
        const uint64_t bitmap = count > g.page_size ? quotient(quotient(count, g.page_size), 8) : 0;
        data_block(g, "FADB", block, bitmap, 0, count, {}, 0);
    }

    // SPEC VII.D. Entries lie in the index block (the first few), in data blocks to which it points, and in data blocks
    // to which secondary blocks point. Level u stands for 2^(u/2) data blocks of 2^((u+1)/2) times the least size; the
    // first levels have no secondary block.
    //   EAHD ..  entry size 1 | bits of a number 1 | entries of the index block 1 | least entries of a data block 1 |
    //            least pointers of a secondary block 1 | bits of a page's entries 1 | .. 32 | used 8 | .. 8 |
    //            index block 8 | sum
    //   EAIB ..  entries | data blocks 8 each | secondary blocks 8 each | sum
    //   EASB ..  number of its first entry | bits of the pages | data blocks 8 each | sum
    //   EADB ..  number of its first entry | entries | sum     or, with pages     .. | sum | pages
    void extensible_array(Grid& g) {
        Cursor c = array_block(g, g.index, "EAHD");
        const auto [size, bits, direct, least, pointers, page_bits] = c.fields(1, 1, 1, 1, 1, 1);
        const auto [statistics, used, realized, block] = c.fields(32, 8, 8, 8);
        c.checksum();
        const bool powers = std::has_single_bit(least) && std::has_single_bit(pointers) && pointers > 1;
        c.expect(powers && log2(least) <= bits && bits <= 48 && page_bits < 48,
                 "an index of at most 2^48 chunks in blocks of powers of two");
        if (block == undefined_address) return;
        g.entry_size = size;
        g.page_size = uint64_t{1} << page_bits;
        const uint64_t levels = 1 + bits - log2(least), in_index = std::min(levels, 2 * log2(pointers));
        const uint64_t offset_width = (bits + 7) / 8;
        const uint64_t addresses_in_index = 2 * (pointers - 1) + levels - in_index;
        Cursor index = array_block(g, block, "EAIB").checked(direct * size + 8 * addresses_in_index);
        entries(g, index, 0, direct);
        uint64_t first = direct;
        for (uint64_t u = 0; u < levels && first < used; ++u) {
            const uint64_t blocks = uint64_t{1} << (u / 2), count = (uint64_t{1} << ((u + 1) / 2)) * least;
            const uint64_t n_pages = count > g.page_size ? count / g.page_size : 0;
            const auto data_blocks = [&](Cursor& addresses, Bytes written) {
                for (uint64_t b = 0; b < blocks; ++b)
                    if (const uint64_t at = addresses.number(8); at != undefined_address && first + b * count < used)
                        data_block(g, "EADB", at, offset_width, first + b * count, count, written, b * n_pages);
            };
            if (u < in_index) {
                index.expect(n_pages == 0, "pages only below secondary blocks");
                data_blocks(index, {});
            } else if (const uint64_t secondary = index.number(8); secondary != undefined_address) {
                const uint64_t bitmap = blocks * quotient(n_pages, 8);
                Cursor s = array_block(g, secondary, "EASB").checked(offset_width + bitmap + 8 * blocks);
                s.take(offset_width);
                const Bytes written = s.take(bitmap);
                data_blocks(s, written);
            }
            first += blocks * count;
        }
    }
};

// Reads everything but the data, from the bytes of a file; `path` is for messages. Errors: hdf5.format, hdf5.truncated,
// hdf5.cycle, hdf5.checksum, hdf5.too_large, hdf5.unsupported.
inline Hdf5File parse_hdf5(std::string bytes, const std::string& path) {
    const auto owner = std::make_shared<const std::string>(std::move(bytes));
    Hdf5File file{path, owner, as_bytes(*owner), {}};
    Hdf5Parser{file}.superblock();
    return file;
}

// Of a file without a superblock nothing more is read. Errors: those of parse_hdf5() and read_file().
inline Hdf5File open_hdf5(const std::string& path) {
    return parse_hdf5(has_superblock(path) ? read_file(path) : "", path);
}

// ---------------------------------------------------------------------------------------------------------------------
// Writing the oldest form, which every version of HDF5 reads: superblock 0, groups as symbol tables, data in one run
// each, uncompressed. Data go to the disk as they come; the structures that describe them follow, the superblock last.
//
//   0             96                                                                            end
//   | superblock | data | data | ... | header of a data set | ... | names, heap, node, tree, header of a group | ...
//
//   Hdf5Writer file("out.hdf5");
//   file.add("infos/qpos", {n, 3}, positions);   a vector, array or span; groups come into being with what they hold
//   file.text("metadata/algorithm", "SAC");
//   file.close();                                without it no file appears
class Hdf5Writer {
  public:
    explicit Hdf5Writer(const std::string& path) : file_(path) { put(std::string(superblock_size, '\0')); }

    // Elements, row-major: float, double, int32_t, or uint8_t for booleans (0 or 1).
    // Errors: hdf5.name, hdf5.shape, hdf5.flag, file.write.
    void add(const std::string& name, const Shape& shape, const std::ranges::contiguous_range auto& range) {
        const std::span data(range);
        using T = typename decltype(data)::value_type;
        if constexpr (std::is_same_v<T, uint8_t>) {
            const bool flags = std::ranges::none_of(data, [](uint8_t flag) { return flag > 1; });
            require(flags, "hdf5.flag", dataset_place(file_.path, name), "a flag is neither 0 nor 1");
        }
        add_raw(name, shape, type_of<T>(), sizeof(T), {reinterpret_cast<const char*>(data.data()), data.size_bytes()});
    }

    // Writes a scalar string of fixed length. HDF5 has no empty types: an empty string becomes one NUL.
    void text(const std::string& name, const std::string& text) {
        const std::string stored = text.empty() ? std::string(1, '\0') : text;
        add_raw(name, {}, std::string("\x13\1\0\0", 4) + little(stored.size(), 4), stored.size(), stored);
    }

    void close() {
        const std::string root = group(root_);
        const std::string start = "\x89HDF\r\n\x1a\n" + std::string(5, '\0') + "\x08\x08" + '\0' + little(leaf_k_, 2) +
                                  little(tree_k, 2) + little(0, 4 + 8) + none + little(position_, 8) + none +
                                  little(0, 8) + root;  // SPEC II.A, version 0
        if (::lseek(file_.file.fd, 0, SEEK_SET) != 0) fail_file("file.write", "go back to its start", file_.path);
        file_.write(start);
        file_.commit();
    }

  private:
    struct Node {
        std::map<std::string, Node> children;  // of a group
        std::string header;                    // of a data set
    };

    static constexpr size_t superblock_size = 96, tree_k = 16;
    inline static const std::string none = std::string(8, '\xFF');  // the undefined address

    // SPEC IV.A.2.d: a datatype message's class, flags, size and properties, as Hdf5Parser::datatype describes them.
    template <class T>
    static std::string_view type_of() {
        using namespace std::string_view_literals;
        if constexpr (std::is_same_v<T, float>) return "\x11\x20\x1F\0\4\0\0\0\0\0\x20\0\x17\x08\0\x17\x7F\0\0\0"sv;
        if constexpr (std::is_same_v<T, double>) return "\x11\x20\x3F\0\x8\0\0\0\0\0\x40\0\x34\x0B\0\x34\xFF\3\0\0"sv;
        if constexpr (std::is_same_v<T, int32_t>) return "\x10\x08\0\0\4\0\0\0\0\0\x20\0"sv;
        if constexpr (std::is_same_v<T, uint8_t>)  // an enumeration of signed bytes
            return "\x18\2\0\0\1\0\0\0\x10\x08\0\0\1\0\0\0\0\0\x08\0FALSE\0\0\0TRUE\0\0\0\0\0\1"sv;
    }  // any other type does not compile: no return

    static std::string little(uint64_t value, size_t size) {  // least significant byte first
        std::string bytes(size, '\0');
        std::memcpy(bytes.data(), &value, std::min<size_t>(size, 8));
        return bytes;
    }
    void put(std::string_view bytes) {
        file_.write(bytes);
        position_ += bytes.size();
    }
    // Puts the bytes at a multiple of 8 and returns their address.
    uint64_t place(std::string_view bytes) {
        put(std::string((8 - position_ % 8) % 8, '\0'));
        put(bytes);
        return position_ - bytes.size();
    }

    // Returns an object header (SPEC IV.A.1.a). Messages are filled up to a multiple of 8 bytes.
    static std::string header(const std::vector<std::pair<uint64_t, std::string>>& messages) {
        std::string body;
        for (const auto& [type, data] : messages) {
            const size_t size = (data.size() + 7) / 8 * 8;
            body += little(type, 2) + little(size, 2) + little(0, 4) + data + std::string(size - data.size(), '\0');
        }
        return little(1, 2) + little(messages.size(), 2) + little(1, 4) + little(body.size(), 4) + little(0, 4) + body;
    }

    void add_raw(const std::string& name, const Shape& shape, std::string_view type, size_t size,
                 std::string_view data) {
        const std::string about_it = dataset_place(file_.path, name);
        std::string space = little(1, 1) + little(shape.size(), 1) + little(0, 6);
        for (const uint64_t extent : shape) {  // `size`: of an element, then of all
            const bool small = !__builtin_mul_overflow(size, extent, &size) && shape.size() <= 32;
            require(small, "hdf5.shape", about_it, "shape ", shape_text(shape), " is too large");
            space += little(extent, 8);
        }
        Node& node = new_node(name);
        require(data.size() == size, "hdf5.shape", about_it, data.size(), " bytes were given, its shape has ", size);
        const uint64_t address = size == 0 ? undefined_address : place(data);
        node.header = header({{0x01, space},                                            // SPEC IV.A.2.b
                              {0x03, std::string(type)},                                // IV.A.2.d
                              {0x05, little(0x01'02'02'02, 4) + little(0, 4)},          // IV.A.2.f: zeros
                              {0x08, "\3\1" + little(address, 8) + little(size, 8)}});  // IV.A.2.i
    }

    // Finds or makes the groups that the name passes through. Errors: hdf5.name.
    Node& new_node(const std::string& name) {
        Node* node = &root_;
        for (size_t at = 0; at <= name.size();) {
            const size_t end = std::min(name.find('/', at), name.size());
            const std::string part = name.substr(at, end - at);
            Node& child = node->children[part];
            const bool in_use = !child.header.empty() || (end == name.size() && !child.children.empty());
            const bool no_name = part.empty() || part == "." || !is_utf8(part) || has_control(part);
            require(!in_use && !no_name && node->children.size() <= 65535, "hdf5.name", dataset_place(file_.path, name),
                    "cannot name a data set: a part of it is in use or is no name");
            leaf_k_ = std::max(leaf_k_, (node->children.size() + 1) / 2);
            node = &child;
            at = end + 1;
        }
        return *node;
    }

    // Writes what the group holds, then itself: its names, heap, symbol node, a tree of this one node, object header,
    // as Hdf5Parser::symbol_table draws them. Returns its entry for the group above (SPEC III.C) but for the name.
    std::string group(const Node& node) {
        std::string names(8, '\0'), entries;
        size_t last_name = 0;
        for (const auto& [name, child] : node.children) {
            last_name = names.size();
            entries += little(last_name, 8);
            entries += child.header.empty() ? group(child) : little(place(child.header), 8) + std::string(24, '\0');
            names += name + std::string(8 - name.size() % 8, '\0');
        }
        const size_t count = node.children.size();
        entries.resize(2 * leaf_k_ * 40);
        const uint64_t segment = place(names);
        const std::string heap_sizes = little(names.size(), 8) + little(1, 8);  // of the names; 1: nothing is free
        const uint64_t heap = place("HEAP" + little(0, 4) + heap_sizes + little(segment, 8));
        const uint64_t leaf = place("SNOD" + little(1, 2) + little(count, 2) + entries);
        std::string keys = little(0, 8) + little(leaf, 8) + little(last_name, 8);
        keys.resize(8 * (4 * tree_k + 1));
        const uint64_t tree = place("TREE" + little(0, 2) + little(count > 0, 2) + none + none + keys);
        const uint64_t address = place(header({{0x11, little(tree, 8) + little(heap, 8)}}));
        return little(address, 8) + little(1, 8) + little(tree, 8) + little(heap, 8);
    }

    AtomicFile file_;
    uint64_t position_ = 0;  // bytes put
    Node root_;
    size_t leaf_k_ = 4;  // half the number of entries in a symbol node of any group: one node must do
};
