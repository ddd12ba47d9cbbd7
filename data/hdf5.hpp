// hdf5.hpp: reads the data sets that others published as HDF5 (D4RL's files, Minari's, whatever h5py writes), writes
// plain ones that any h5py reads, and takes the SHA-256 of a file, by which a published file is recognised.
//
//   superblock ---> root group ----> link "actions" ----> object header of a data set
//   (where the      object header    link "infos" --+       shape     (4, 3)
//   root group is)  + a table        ...            |       type      float32, either byte order
//                   of links                        |       filters   shuffle, deflate, fletcher32
//                                                   |       layout ---> one run of bytes, or an index of chunks:
//                                                   v
//                                        group "infos": the same       +-------+-------+ every chunk has the same
//                                        again, one level down         | chunk | chunk | extents (here 2 x 2), the
//                                                                      +-------+--+----+ last ones hang over the
//   A group is a symbol table (old files) or link messages,            | chunk | ch|unk  edge; each is filtered by
//   in the header or in a heap (new files). Chunks are found           +-------+--+----+ itself; one that is missing
//   through one of six indexes (Hdf5Parser below).                                       has the fill value
//
// SPEC below is the "HDF5 File Format Specification Version 3.0" (The HDF Group); no code of theirs was used.
// Promises: what is read is what h5py reads; every checksum of what is read is verified; no input crashes or hangs the
// reader or makes it allocate out of proportion; every error names the file, the object, the offset and what was
// expected there. Leaves out: attributes, compound, variable-length and other types, filters but those three, soft and
// external links, shared messages, virtual data sets (these data sets are listed, and refused when read), layout
// messages before version 3 (HDF5 1.6.2 and older), rows in part. While a file is open nobody may shorten it (mmap).
#pragma once

#include <sys/mman.h>

#include <memory>
#include <set>

#include "safetensors.hpp"

using Bytes = std::span<const uint8_t>;

// A whole file as memory, without loading it.
struct MappedFile {
    Bytes bytes;

    explicit MappedFile(const std::string& path) {
        const FileDescriptor file(::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK));  // a pipe must not block us
        if (file.fd < 0) fail_file("file.open", "open it", path);
        const size_t size = regular_file_size(file, path);
        if (size == 0) return;  // mmap refuses it
        void* start = ::mmap(nullptr, size, PROT_READ, MAP_PRIVATE, file.fd, 0);
        if (start == MAP_FAILED) fail_file("file.read", "map it into memory", path);
        bytes = {static_cast<const uint8_t*>(start), size};
    }
    MappedFile(const MappedFile&) = delete;
    MappedFile& operator=(const MappedFile&) = delete;
    ~MappedFile() {
        if (!bytes.empty()) ::munmap(const_cast<uint8_t*>(bytes.data()), bytes.size());
    }
};

inline Bytes as_bytes(std::string_view text) { return {reinterpret_cast<const uint8_t*>(text.data()), text.size()}; }

// Up to 8 bytes, least significant first.
inline uint64_t little_endian(Bytes bytes) {
    uint64_t value = 0;
    if (!bytes.empty()) std::memcpy(&value, bytes.data(), bytes.size());
    return value;
}

// Then a terminal would not print it as it is.
inline bool has_control(std::string_view name) {
    return std::ranges::any_of(name, [](char c) { return (c >= 0 && c < 0x20) || c == 0x7F; });
}

// ---------------------------------------------------------------------------------------------------------------------
// Checksums

// FIPS 180-4, sections 5.1.1 and 6.2. Hexadecimal digits.
inline std::string sha256(Bytes message) {
    static constexpr uint32_t constants[64] = {
        0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4, 0xab1c5ed5,
        0xd807aa98, 0x12835b01, 0x243185be, 0x550c7dc3, 0x72be5d74, 0x80deb1fe, 0x9bdc06a7, 0xc19bf174,
        0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc, 0x2de92c6f, 0x4a7484aa, 0x5cb0a9dc, 0x76f988da,
        0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7, 0xc6e00bf3, 0xd5a79147, 0x06ca6351, 0x14292967,
        0x27b70a85, 0x2e1b2138, 0x4d2c6dfc, 0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85,
        0xa2bfe8a1, 0xa81a664b, 0xc24b8b70, 0xc76c51a3, 0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070,
        0x19a4c116, 0x1e376c08, 0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f, 0x682e6ff3,
        0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208, 0x90befffa, 0xa4506ceb, 0xbef9a3f7, 0xc67178f2};
    std::array<uint32_t, 8> hash = {0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a,
                                    0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
    const auto block = [&hash](const uint8_t* bytes) {
        uint32_t w[64];
        for (size_t t = 0; t < 16; ++t) {
            std::memcpy(&w[t], bytes + 4 * t, 4);
            w[t] = __builtin_bswap32(w[t]);
        }
        for (size_t t = 16; t < 64; ++t) {
            const uint32_t x = w[t - 15], y = w[t - 2];
            const uint32_t s0 = std::rotr(x, 7) ^ std::rotr(x, 18) ^ x >> 3;
            w[t] = (std::rotr(y, 17) ^ std::rotr(y, 19) ^ y >> 10) + w[t - 7] + s0 + w[t - 16];
        }
        auto [a, b, c, d, e, f, g, h] = hash;
        for (size_t t = 0; t < 64; ++t) {
            const uint32_t s1 = std::rotr(e, 6) ^ std::rotr(e, 11) ^ std::rotr(e, 25);
            const uint32_t s0 = std::rotr(a, 2) ^ std::rotr(a, 13) ^ std::rotr(a, 22);
            const uint32_t t1 = h + s1 + ((e & f) ^ (~e & g)) + constants[t] + w[t];
            const uint32_t t2 = s0 + ((a & b) ^ (a & c) ^ (b & c));
            h = g, g = f, f = e, e = d + t1, d = c, c = b, b = a, a = t1 + t2;
        }
        const uint32_t added[8] = {a, b, c, d, e, f, g, h};
        for (size_t i = 0; i < 8; ++i) hash[i] += added[i];
    };
    const size_t whole = message.size() / 64 * 64;
    for (size_t at = 0; at < whole; at += 64) block(message.data() + at);
    uint8_t tail[128] = {};  // the rest, a one bit, zeros, the length in bits
    const size_t rest = message.size() - whole, end = rest < 56 ? 64 : 128;
    if (rest > 0) std::memcpy(tail, message.data() + whole, rest);
    tail[rest] = 0x80;
    for (size_t i = 0; i < 8; ++i) tail[end - 1 - i] = static_cast<uint8_t>(message.size() * 8 >> (8 * i));
    for (size_t at = 0; at < end; at += 64) block(tail + at);
    std::string digits;
    for (const uint32_t word : hash) digits += hex8(word);
    return digits;
}

inline std::string sha256_of_file(const std::string& path) { return sha256(MappedFile(path).bytes); }

// Bob Jenkins's lookup3, hashlittle() with initial value 0: the checksum of all newer structures
// (http://burtleburtle.net/bob/hash/doobs.html).
inline uint32_t lookup3(Bytes key) {
    uint32_t a = 0xDEADBEEF + static_cast<uint32_t>(key.size()), b = a, c = a;
    const auto add = [&](size_t count) {  // up to 12 bytes; missing ones are zeros
        uint32_t words[3] = {};
        std::memcpy(words, key.data(), count);
        a += words[0], b += words[1], c += words[2];
        key = key.subspan(count);
    };
    const auto step = [](uint32_t& x, uint32_t& y, uint32_t z, int bits) { x -= y, x ^= std::rotl(y, bits), y += z; };
    while (key.size() > 12) {
        add(12);
        step(a, c, b, 4), step(b, a, c, 6), step(c, b, a, 8), step(a, c, b, 16), step(b, a, c, 19), step(c, b, a, 4);
    }
    if (key.empty()) return c;
    add(key.size());
    const auto last = [](uint32_t& x, uint32_t y, int bits) { x = (x ^ y) - std::rotl(y, bits); };
    last(c, b, 14), last(a, c, 11), last(b, a, 25), last(c, b, 16), last(a, c, 4), last(b, a, 14), last(c, b, 24);
    return c;
}

// Fletcher's checksum of big-endian 16-bit words as HDF5's filter 3 takes it. 65535 stands for 0 unless all are zero.
inline uint32_t fletcher32(Bytes bytes) {
    uint64_t sum1 = 0, sum2 = 0;
    const auto fold = [](uint64_t& sum) {
        while (sum > 65535) sum = (sum & 65535) + (sum >> 16);
    };
    for (size_t i = 0; i < bytes.size(); i += 2) {
        sum1 += static_cast<uint32_t>(bytes[i] << 8 | (i + 1 < bytes.size() ? bytes[i + 1] : 0));
        sum2 += sum1;
        if ((i & 0xFFFE) == 0xFFFE) fold(sum1), fold(sum2);
    }
    fold(sum1), fold(sum2);
    return static_cast<uint32_t>(sum2 << 16 | sum1);
}

// RFC 1950, section 2.2 and 8.
inline uint32_t adler32(Bytes bytes) {
    uint32_t a = 1, b = 0;
    while (!bytes.empty()) {
        const Bytes part = bytes.first(std::min<size_t>(bytes.size(), 5552));  // b stays below 2^32
        for (const uint8_t byte : part) a += byte, b += a;
        a %= 65521, b %= 65521;
        bytes = bytes.subspan(part.size());
    }
    return b << 16 | a;
}

// ---------------------------------------------------------------------------------------------------------------------
// Inflate (RFC 1951 in the wrapper of RFC 1950). A code of up to `root` bits takes one look-up, a longer one two.

struct HuffmanTable {
    // An entry: bits 0 to 4 the length of the code, 5 to 7 its kind, 8 to 15 `extra` bits that follow, 16 to 31 a value.
    enum Kind : uint32_t { invalid = 0, literal = 1 << 5, number = 2 << 5, end_of_block = 3 << 5, longer = 4 << 5 };
    static constexpr uint32_t root = 10;
    std::array<uint32_t, (1 << root) + 288 * 32> entries;  // a second level of at most 2^(15 - root) for each symbol

    // lengths[s]: bits of the code of symbol s, 0 if it has none; meaning[s]: its entry but for the length (section
    // 3.2.2). A code must be complete, but for one of a single bit or none at all (section 3.2.7). False if not so.
    bool build(std::span<const uint8_t> lengths, std::span<const uint32_t> meaning) {
        std::array<uint32_t, 16> count{}, next{};
        for (const uint8_t length : lengths) ++count[length];
        count[0] = 0;
        uint32_t code = 0, used = 0;  // `used` in units of 2^-15
        for (uint32_t length = 1; length < 16; ++length) {
            code = (code + count[length - 1]) << 1;
            next[length] = code;
            used += count[length] << (15 - length);
        }
        if (used != 0 && used != 1 << 15 && !(used == 1 << 14 && count[1] == 1)) return false;
        std::fill_n(entries.begin(), 1 << root, invalid);
        std::array<uint32_t, 288> codes;
        std::array<uint8_t, 1 << root> deepest{};
        for (size_t s = 0; s < lengths.size(); ++s) {  // codes come with their first bit lowest
            const uint32_t length = lengths[s];
            uint32_t forward = length == 0 ? 0 : next[length]++, reversed = 0;
            for (uint32_t bit = 0; bit < length; ++bit, forward >>= 1) reversed = reversed << 1 | (forward & 1);
            codes[s] = reversed;
            uint8_t& deep = deepest[reversed & ((1 << root) - 1)];
            if (length > root) deep = std::max(deep, lengths[s]);
        }
        uint32_t size = 1 << root;
        for (size_t s = 0; s < lengths.size(); ++s) {
            const uint32_t length = lengths[s], first = codes[s] & ((1 << root) - 1);
            if (length == 0) continue;
            if (length <= root) {
                for (uint32_t i = first; i < 1 << root; i += 1 << length) entries[i] = meaning[s] | length;
                continue;
            }
            const uint32_t bits = deepest[first] - root;
            if (entries[first] == invalid) {
                entries[first] = size << 16 | bits << 8 | longer;
                std::fill_n(entries.begin() + size, 1 << bits, invalid);
                size += 1 << bits;
            }
            for (uint32_t i = codes[s] >> root; i < 1u << bits; i += 1u << (length - root))
                entries[(entries[first] >> 16) + i] = meaning[s] | length;
        }
        return true;
    }
};

// Section 3.2.5: symbols 257 to 285 are lengths 3 to 258; 0 to 29 distances 1 to 32768. 286, 287, 30 and 31 are invalid.
inline constexpr auto length_meaning = [] {
    using enum HuffmanTable::Kind;
    std::array<uint32_t, 288> meaning{};
    for (uint32_t s = 0; s < 256; ++s) meaning[s] = literal | s << 16;
    meaning[256] = end_of_block;
    for (uint32_t s = 257, base = 3; s < 285; ++s) {
        const uint32_t extra = s < 261 ? 0 : (s - 261) / 4;
        meaning[s] = number | extra << 8 | base << 16;
        base += 1u << extra;
    }
    meaning[285] = number | 258u << 16;
    return meaning;
}();
inline constexpr auto distance_meaning = [] {
    std::array<uint32_t, 32> meaning{};
    for (uint32_t s = 0, base = 1; s < 30; ++s) {
        const uint32_t extra = s < 2 ? 0 : s / 2 - 1;
        meaning[s] = HuffmanTable::number | extra << 8 | base << 16;
        base += 1u << extra;
    }
    return meaning;
}();

// Bits of a stream, lowest first.
struct BitReader {
    const uint8_t *in, *in_end;
    uint64_t bits = 0;
    int count = 0;  // of valid bits; below 0: the input ended, and zeros were taken for it

    // At least 56 bits, as long as there is input.
    void refill() {
        if (in_end - in >= 8) {
            uint64_t word;
            std::memcpy(&word, in, 8);
            bits |= word << count;
            in += (63 - count) >> 3;
            count |= 56;
        } else {
            for (; count < 56 && in < in_end; count += 8) bits |= static_cast<uint64_t>(*in++) << count;
        }
    }
    uint32_t take(uint32_t n) {  // n < 32
        const auto value = static_cast<uint32_t>(bits & ((uint64_t{1} << n) - 1));
        bits >>= n;
        count -= static_cast<int>(n);
        return value;
    }
    uint32_t decode(const HuffmanTable& table) {
        uint32_t entry = table.entries[bits & ((1 << HuffmanTable::root) - 1)];
        if ((entry & 0xE0) == HuffmanTable::longer)
            entry = table.entries[(entry >> 16) + (bits >> HuffmanTable::root & ((1u << (entry >> 8 & 255)) - 1))];
        take(entry & 31);
        return entry;
    }
};

// Each part returns null or what is wrong.
struct Inflater {
    using enum HuffmanTable::Kind;
    BitReader source;
    uint8_t *out_start, *out, *out_end;
    HuffmanTable lengths = {}, distances = {};

    static constexpr const char *cut_off = "the end of the compressed data",
                                *too_much = "more data than the chunk holds";

    const char* stored() {  // section 3.2.4
        BitReader& s = source;
        s.in -= s.count / 8, s.bits = 0, s.count = 0;
        if (s.in_end - s.in < 4) return cut_off;
        const size_t size = little_endian({s.in, 2}), inverse = little_endian({s.in + 2, 2});
        s.in += 4;
        if (size != (~inverse & 65535)) return "a stored block whose length does not match its complement";
        if (static_cast<size_t>(s.in_end - s.in) < size) return cut_off;
        if (static_cast<size_t>(out_end - out) < size) return too_much;
        if (size > 0) std::memcpy(out, s.in, size);
        s.in += size, out += size;
        return nullptr;
    }

    const char* read_codes() {  // section 3.2.7
        constexpr uint8_t order[19] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
        std::array<uint8_t, 19> first{};
        std::array<uint8_t, 286 + 30 + 137> found{};  // the last repetition may run over
        source.refill();
        const size_t n_lengths = source.take(5) + 257, n_distances = source.take(5) + 1, n_order = source.take(4) + 4;
        if (n_lengths > 286 || n_distances > 30) return "too many codes";
        for (size_t i = 0; i < n_order; ++i) {
            source.refill();
            first[order[i]] = static_cast<uint8_t>(source.take(3));
        }
        if (!lengths.build(first, length_meaning)) return "an invalid code of code lengths";
        for (size_t at = 0; at < n_lengths + n_distances;) {
            source.refill();
            const uint32_t entry = source.decode(lengths), symbol = entry >> 16;
            if ((entry & 0xE0) != literal || source.count < 0) return "an invalid code length";
            if (symbol == 16 && at == 0) return "a repeated code length before the first";
            const auto value = static_cast<uint8_t>(symbol < 16 ? symbol : symbol == 16 ? found[at - 1] : 0);
            const uint32_t times = symbol < 16    ? 1
                                   : symbol == 16 ? 3 + source.take(2)
                                   : symbol == 17 ? 3 + source.take(3)
                                                  : 11 + source.take(7);
            for (uint32_t i = 0; i < times; ++i) found[at++] = value;
            if (at > n_lengths + n_distances) return "more code lengths than codes";
        }
        if (found[256] == 0) return "no code for the end of the block";
        return lengths.build(std::span(found).first(n_lengths), length_meaning) &&
                       distances.build(std::span(found).subspan(n_lengths, n_distances), distance_meaning)
                   ? nullptr
                   : "an invalid set of code lengths";
    }

    const char* compressed() {
        BitReader s = source;  // a copy: bytes that are written could be part of *this, for all the compiler knows
        uint8_t* to = out;
        for (;;) {
            s.refill();  // a length, a distance and the bits after each take 48 at most
            uint32_t entry = s.decode(lengths);
            if ((entry & 0xE0) == literal && to < out_end) {  // then there are 41 bits left, enough for one more
                *to++ = static_cast<uint8_t>(entry >> 16);
                entry = s.decode(lengths);
                if ((entry & 0xE0) != literal) s.refill();
            }
            if (s.count < 0) return cut_off;
            if ((entry & 0xE0) == literal) {
                if (to == out_end) return too_much;
                *to++ = static_cast<uint8_t>(entry >> 16);
                continue;
            }
            if ((entry & 0xE0) == end_of_block) break;
            if ((entry & 0xE0) != number) return "a code that stands for nothing";
            const size_t length = (entry >> 16) + s.take(entry >> 8 & 255);
            const uint32_t far = s.decode(distances);
            if ((far & 0xE0) != number) return "a code that stands for nothing";
            const size_t distance = (far >> 16) + s.take(far >> 8 & 255);
            if (s.count < 0) return cut_off;
            if (distance > static_cast<size_t>(to - out_start)) return "a distance to before the start";
            if (length > static_cast<size_t>(out_end - to)) return too_much;
            const uint8_t* from = to - distance;
            uint8_t* const end = to + length;
            if (distance >= 8 && out_end - end >= 8) {  // whole words, up to 7 bytes too many
                for (; to < end; to += 8, from += 8) std::memcpy(to, from, 8);
                to = end;
            } else {
                while (to < end) *to++ = *from++;
            }
        }
        source = s, out = to;
        return nullptr;
    }

    const char* run() {  // section 3.2.3
        for (bool last = false; !last;) {
            source.refill();
            last = source.take(1) == 1;
            const uint32_t type = source.take(2);
            if (source.count < 0) return cut_off;
            if (type == 3) return "a block of type 3";
            const char* wrong = nullptr;
            if (type == 1) {  // section 3.2.6
                std::array<uint8_t, 288> fixed;
                for (size_t s = 0; s < 288; ++s) fixed[s] = s < 144 ? 8 : s < 256 ? 9 : s < 280 ? 7 : 8;
                lengths.build(fixed, length_meaning);
                fixed.fill(5);
                distances.build(std::span(fixed).first(32), distance_meaning);
            }
            if (type == 2) wrong = read_codes();
            if (wrong == nullptr) wrong = type == 0 ? stored() : compressed();
            if (wrong != nullptr) return wrong;
        }
        source.in -= source.count / 8;
        return nullptr;
    }
};

// Fills `out`, which must have the exact size of the data. Null, or what was found that should not be.
inline const char* inflate_zlib(Bytes in, std::span<uint8_t> out) {
    if (in.size() < 6 || (in[0] & 15) != 8 || in[0] >> 4 > 7 || (in[0] << 8 | in[1]) % 31 != 0 || (in[1] & 32) != 0)
        return "no zlib header";
    const BitReader source{in.data() + 2, in.data() + in.size() - 4};
    const auto state = std::make_unique<Inflater>(source, out.data(), out.data(), out.data() + out.size());  // 80 kB
    if (const char* wrong = state->run()) return wrong;
    if (state->out != state->out_end) return "less data than the chunk holds";
    if (state->source.in != source.in_end) return "bytes after the end of the compressed data";
    return __builtin_bswap32(static_cast<uint32_t>(little_endian(in.last(4)))) == adler32(out)
               ? nullptr
               : "data that does not match its Adler-32 checksum";
}

// ---------------------------------------------------------------------------------------------------------------------
// What a file holds

// SPEC IV.A.2.d: how one element is stored.
struct Hdf5Element {
    enum Kind : uint8_t { other, floating, signed_integer, unsigned_integer, text } kind = other;
    bool big_endian = false;
    uint8_t padding = 0;  // of text: 0 ends with a NUL (if there is room), 1 filled up with NULs, 2 with spaces
    size_t size = 0;      // bytes
};

// N elements to T (float, double; uint8_t: 0, 1, or 255 for any other value), `size` bytes each.
template <class T, size_t size>
void convert_elements(const Hdf5Element& element, const uint8_t* from, T* to, size_t n) {
    const auto store = [](auto value) {
        if constexpr (std::is_same_v<T, uint8_t>) return static_cast<uint8_t>(value == 0 ? 0 : value == 1 ? 1 : 255);
        if constexpr (!std::is_same_v<T, uint8_t>) return static_cast<T>(value);
    };
    constexpr int unused = 64 - 8 * static_cast<int>(size);
    for (size_t i = 0; i < n; ++i) {
        uint64_t bits = 0;
        std::memcpy(&bits, from + i * size, size);
        if (element.big_endian) bits = __builtin_bswap64(bits) >> unused;
        if (element.kind == Hdf5Element::floating)
            to[i] = size == 4 ? store(std::bit_cast<float>(static_cast<uint32_t>(bits)))
                              : store(std::bit_cast<double>(bits));
        else if (element.kind == Hdf5Element::signed_integer)
            to[i] = store(static_cast<int64_t>(bits << unused) >> unused);
        else
            to[i] = store(bits);
    }
}

template <class T>
void convert_elements(const Hdf5Element& element, const uint8_t* from, T* to, size_t n) {
    const auto choose = [&]<size_t... k>(std::index_sequence<k...>) {
        (void)((element.size == k + 1 && (convert_elements<T, k + 1>(element, from, to, n), true)) || ...);
    };
    choose(std::make_index_sequence<8>());
}

struct Hdf5Chunk {
    uint64_t address, size;  // where and how many bytes in the file
    uint64_t place;          // in the grid of chunks, row-major
    uint32_t skipped;        // bit i: filter i was not applied
};

enum class Hdf5Filter : uint16_t { deflate = 1, shuffle = 2, fletcher = 3 };

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
    size_t elements = 1, chunk_bytes = 0;  // products that fit: checked when the file was opened
};

struct Hdf5File {
    std::string path;
    std::shared_ptr<const void> owner;  // of `bytes`
    Bytes bytes;                        // the file from its superblock on; all addresses count from there
    std::vector<Hdf5Dataset> datasets;  // sorted by path, bytewise

    // Null if there is none.
    const Hdf5Dataset* find(std::string_view name) const {
        const auto found = std::ranges::lower_bound(datasets, name, {}, &Hdf5Dataset::path);
        return found != datasets.end() && found->path == name ? &*found : nullptr;
    }

    // All elements, row-major. Numbers of any kind convert to the nearest float or double (float64 to float32 rounds to
    // the nearest, and to infinity beyond the range; integers above 2^24 or 2^53 round).
    std::vector<float> read_floats(const Hdf5Dataset& dataset) const { return read<float>(dataset); }
    std::vector<double> read_doubles(const Hdf5Dataset& dataset) const { return read<double>(dataset); }

    // The same, for booleans stored as any kind of number: anything but 0 and 1 (NaN included) is an error.
    std::vector<uint8_t> read_flags(const Hdf5Dataset& dataset) const {
        std::vector<uint8_t> flags = read<uint8_t>(dataset);
        const auto other = std::ranges::find(flags, 255);
        if (other != flags.end())
            fail("hdf5.flag", "%s: element %zu is neither 0 nor 1, so this is no data set of flags",
                 where(dataset).c_str(), static_cast<size_t>(other - flags.begin()));
        return flags;
    }

    // One fixed-length string without its padding.
    std::string read_text(const Hdf5Dataset& dataset) const {
        check_readable(dataset, dataset.element.kind == Hdf5Element::text && dataset.elements == 1, "one text");
        std::array<std::vector<uint8_t>, 2> buffers;
        Bytes found = dataset.chunks.empty() ? dataset.fill : decode(dataset, dataset.chunks[0], buffers);
        std::string text(found.begin(),
                         found.begin() + static_cast<ptrdiff_t>(std::min(found.size(), dataset.element.size)));
        if (dataset.element.padding == 0) text.resize(std::min(text.size(), text.find('\0')));
        const char pad = dataset.element.padding == 2 ? ' ' : '\0';
        while (!text.empty() && text.back() == pad) text.pop_back();
        return text;
    }

    std::string where(const Hdf5Dataset& dataset) const { return path + ": " + json_string(dataset.path); }

    void check_readable(const Hdf5Dataset& dataset, bool suits, const char* wanted) const {
        if (!dataset.unsupported.empty())
            fail("hdf5.unsupported", "%s: cannot be read: %s", where(dataset).c_str(), dataset.unsupported.c_str());
        if (!suits)
            fail("hdf5.type", "%s: is %s of shape %s, expected %s", where(dataset).c_str(), dataset.type.c_str(),
                 shape_text(dataset.shape).c_str(), wanted);
    }

    // The chunk_bytes bytes of a chunk, filters undone (SPEC IV.A.2.l); they lie in the file or in one of the buffers.
    Bytes decode(const Hdf5Dataset& dataset, const Hdf5Chunk& chunk,
                 std::array<std::vector<uint8_t>, 2>& buffers) const {
        const auto damaged = [&](const char* id, const char* found) {
            fail(id, "%s: chunk at offset %zu: found %s; the file is damaged, use another copy", where(dataset).c_str(),
                 static_cast<size_t>(chunk.address), found);
        };
        Bytes data = bytes.subspan(chunk.address, chunk.size);
        for (size_t i = dataset.filters.size(); i-- > 0;) {
            if ((chunk.skipped >> i & 1) != 0) continue;
            const Hdf5Filter filter = dataset.filters[i];
            if (filter == Hdf5Filter::fletcher) {
                if (data.size() < 4) damaged("hdf5.checksum", "no room for a checksum");
                const Bytes stored = data.last(4);
                data = data.first(data.size() - 4);
                if (little_endian(stored) != fletcher32(data))
                    damaged("hdf5.checksum", "data that do not match their Fletcher-32 checksum");
                continue;
            }
            std::vector<uint8_t>& out = buffers[data.data() == buffers[0].data()];  // not the one that is read
            if (filter == Hdf5Filter::deflate) {  // earlier filters may have added checksums
                size_t size = dataset.chunk_bytes;
                for (size_t k = 0; k < i; ++k)
                    size += dataset.filters[k] == Hdf5Filter::fletcher && (chunk.skipped >> k & 1) == 0 ? 4 : 0;
                out.resize(size);
                if (const char* wrong = inflate_zlib(data, out)) damaged("hdf5.deflate", wrong);
            } else {  // byte j of all elements, then byte j + 1 of all; a rest that is no whole element stays as it was
                out.assign(data.begin(), data.end());
                const size_t width = dataset.element.size, count = data.size() / width;
                for (size_t j = 0; j < width; ++j)
                    for (size_t k = 0; k < count; ++k) out[k * width + j] = data[j * count + k];
            }
            data = out;
        }
        if (data.size() != dataset.chunk_bytes) damaged("hdf5.format", "a chunk of another size than the others");
        return data;
    }

    template <class T>
    std::vector<T> read(const Hdf5Dataset& dataset) const {
        const Hdf5Element& element = dataset.element;
        check_readable(dataset, element.kind != Hdf5Element::text, "numbers");
        T filled{};
        if (!dataset.fill.empty()) convert_elements(element, dataset.fill.data(), &filled, 1);
        std::vector<T> out(dataset.elements, filled);
        const size_t rank = dataset.shape.size();
        std::vector<size_t> grid(rank), start(rank), extent(rank), at(rank);
        for (size_t k = 0; k < rank && dataset.elements > 0; ++k)
            grid[k] = (dataset.shape[k] - 1) / dataset.chunk[k] + 1;
        std::array<std::vector<uint8_t>, 2> buffers;
        for (const Hdf5Chunk& chunk : dataset.chunks) {
            const Bytes data = decode(dataset, chunk, buffers);
            for (size_t k = rank, rest = chunk.place; k-- > 0; rest /= grid[k]) {
                start[k] = rest % grid[k] * dataset.chunk[k];
                extent[k] = std::min(dataset.chunk[k], dataset.shape[k] - start[k]);
            }
            // The last dimensions, as long as they have no gaps on either side, make one run; the others are counted.
            size_t outer = rank, run = 1;
            for (bool whole = true; outer > 0 && whole;) {
                --outer;
                run *= extent[outer];
                whole = extent[outer] == dataset.chunk[outer] && extent[outer] == dataset.shape[outer];
            }
            std::ranges::fill(at, 0);
            for (bool more = true; more;) {
                size_t from = 0, to = 0;
                for (size_t k = 0; k < rank; ++k) {
                    from = from * dataset.chunk[k] + at[k];
                    to = to * dataset.shape[k] + start[k] + at[k];
                }
                convert_elements(element, data.data() + from * element.size, out.data() + to, run);
                more = false;
                for (size_t k = outer; k-- > 0 && !more;) {
                    more = ++at[k] < extent[k];
                    if (!more) at[k] = 0;
                }
            }
        }
        return out;
    }
};

// ---------------------------------------------------------------------------------------------------------------------
// Reading the structures

inline constexpr uint64_t undefined_address = ~uint64_t{0};  // SPEC V

// Links in a circle, or one structure used again and again, end when more has been read than `budget`, a few times the
// size of the file; this also bounds what is allocated. Depths are bounded where they occur.
struct Hdf5Parser {
    Hdf5File& file;
    size_t budget = 16 * file.bytes.size() + (1 << 21);
    std::string object = "superblock";  // being read, for messages
    std::set<uint64_t> groups = {};     // addresses already visited

    [[noreturn]] void damaged(const char* id, uint64_t offset, const std::string& expected) const {
        fail(id, "%s: %s: offset %zu: expected %s; the file is damaged or of a kind unknown to this reader",
             file.path.c_str(), object.c_str(), static_cast<size_t>(offset), expected.c_str());
    }
    // The one place that touches the file's structures.
    Bytes bytes(uint64_t offset, uint64_t n) {
        if (offset > file.bytes.size() || n > file.bytes.size() - offset)
            damaged("hdf5.truncated", offset,
                    std::to_string(n) + " bytes (the file ends at " + std::to_string(file.bytes.size()) + ")");
        charge(offset, n);
        return file.bytes.subspan(offset, n);
    }
    void charge(uint64_t offset, uint64_t n) {
        if (n > budget) damaged("hdf5.cycle", offset, "an end: structures refer to each other in a circle");
        budget -= n;
    }
    uint64_t product(uint64_t a, uint64_t b, uint64_t offset) const {
        uint64_t result;
        if (__builtin_mul_overflow(a, b, &result)) damaged("hdf5.too_large", offset, "a size of at most 64 bits");
        return result;
    }

    static constexpr uint64_t no_limit = ~uint64_t{0};  // to an extent: SPEC IV.A.2.b
    static uint64_t log2(uint64_t value) { return static_cast<uint64_t>(std::bit_width(value)) - 1; }

    // Reads one thing after the other.
    struct Cursor {
        Hdf5Parser& parser;
        uint64_t at, end;
        uint64_t start = at;

        Bytes take(uint64_t n) {
            if (n > end - at)
                parser.damaged("hdf5.truncated", at, std::to_string(n) + " bytes before " + std::to_string(end));
            at += n;
            return parser.bytes(at - n, n);
        }
        uint64_t number(uint64_t size) { return little_endian(take(size)); }
        void expect(bool holds, const std::string& what, const char* id = "hdf5.format") const {
            if (!holds) parser.damaged(id, start, what);
        }
        // A signature and a version.
        void begins(std::string_view signature, uint64_t version) {
            const Bytes found = take(signature.size());
            expect(std::ranges::equal(found, as_bytes(signature)), "the signature " + std::string(signature));
            expect(number(1) == version, "version " + std::to_string(version) + " after " + std::string(signature));
        }
        // Bytes `start` to here, then their checksum.
        void checksum() {
            const Bytes covered = parser.file.bytes.subspan(start, at - start);
            expect(number(4) == lookup3(covered), "data that match their checksum", "hdf5.checksum");
        }
    };
    Cursor cursor(uint64_t address) {
        bytes(address, 0);
        return {*this, address, file.bytes.size()};
    }
    Cursor cursor(uint64_t address, uint64_t size) {
        bytes(address, 0), bytes(address, size), budget += size;  // charged when it is taken
        return {*this, address, address + size};
    }

    // SPEC II.A. The signature is at 0, 512, 1024, 2048, ...: others may keep what they like before it.
    void superblock() {
        constexpr std::string_view signature = "\x89HDF\r\n\x1a\n";
        const Bytes all = file.bytes;
        size_t base = 0;
        const auto found = [&] { return std::ranges::equal(all.subspan(base, 8), as_bytes(signature)); };
        while (base + 8 <= all.size() && !found()) base = base == 0 ? 512 : 2 * base;
        if (base + 8 > all.size())
            fail("hdf5.format", "%s: is not an HDF5 file (it has no superblock)", file.path.c_str());
        file.bytes = all.subspan(base);
        Cursor c = cursor(0);
        c.take(8);
        const uint64_t version = c.number(1);
        c.expect(version <= 3, "a superblock of version 0 to 3");
        if (version < 2) c.take(4);
        c.expect(c.number(1) == 8 && c.number(1) == 8, "offsets and lengths of 8 bytes", "hdf5.unsupported");
        c.take(version == 0 ? 9 : version == 1 ? 13 : 1);
        c.take(16);  // base address; free space or superblock extension
        const uint64_t end = c.number(8);
        if (end > all.size())
            fail("hdf5.truncated", "%s: has %zu bytes, its superblock says %zu; the file was cut off",
                 file.path.c_str(), all.size(), static_cast<size_t>(end));
        if (version < 2) c.take(16);  // driver information; the root group's name
        const uint64_t root = c.number(8);
        if (version >= 2) c.checksum();
        link("", root, 0);
        std::ranges::sort(file.datasets, {}, &Hdf5Dataset::path);
    }

    // --- Object headers, SPEC IV.A.1

    struct Message {
        uint64_t type, flags;
        Cursor data;
    };

    std::vector<Message> messages(uint64_t address) {
        std::vector<Message> out;
        std::vector<Cursor> blocks;
        const bool old = bytes(address, 1)[0] == 1;
        uint64_t prefix = 8, extra = 0;  // before the data of a message
        Cursor c = cursor(address);
        if (old) {  // IV.A.1.a
            c.take(8);
            const uint64_t size = c.number(4);
            c.take(4);
            blocks.push_back(cursor(c.at, size));
        } else {  // IV.A.1.b
            c.begins("OHDR", 2);
            const uint64_t flags = c.number(1);
            c.take(((flags & 32) != 0 ? 16 : 0) + ((flags & 16) != 0 ? 4 : 0));
            const uint64_t size = c.number(uint64_t{1} << (flags & 3));
            extra = (flags & 4) != 0 ? 2 : 0;
            prefix = 4 + extra;
            blocks.push_back(cursor(c.at, size));
            c.take(size);
            c.checksum();
        }
        for (size_t b = 0; b < blocks.size(); ++b) {
            Cursor block = blocks[b];
            while (block.end - block.at >= prefix) {
                const uint64_t type = block.number(old ? 2 : 1), size = block.number(2), flags = block.number(1);
                block.take(old ? 3 : extra);
                const Cursor data = cursor(block.at, size);
                block.expect(size <= block.end - block.at, "a message within its block");
                block.at += size;
                if (type != 0x10) {
                    if (type != 0) out.push_back({type, flags, data});
                    continue;
                }
                Cursor next = data;  // a continuation block, IV.A.2.q
                const uint64_t where = next.number(8), length = next.number(8);
                Cursor more = cursor(where, length);
                if (!old) {
                    block.expect(length >= 8, "a continuation block of at least 8 bytes");
                    more.end -= 4;
                    more.expect(std::ranges::equal(more.take(4), as_bytes("OCHK")), "the signature OCHK");
                    Cursor check = more;
                    check.end += 4;
                    check.take(length - 8);
                    check.checksum();
                }
                blocks.push_back(more);
            }
        }
        return out;
    }

    // --- Groups

    struct Link {
        std::string name;
        uint64_t address;
    };

    // What a link leads to. A link to a named type is passed over.
    void link(const std::string& path, uint64_t address, int depth) {
        object = path.empty() ? "root group" : json_string(path);
        if (depth > 32 || path.size() > 4096) damaged("hdf5.cycle", address, "at most 32 groups in each other");
        const std::vector<Message> header = messages(address);
        const auto has = [&](uint64_t type) { return std::ranges::find(header, type, &Message::type) != header.end(); };
        if (has(0x08)) return dataset(path, header);
        if (!has(0x11) && !has(0x02)) return;
        if (!groups.insert(address).second) damaged("hdf5.cycle", address, "a group that is linked to once");
        std::vector<Link> links;
        for (const Message& message : header) {
            if (message.type == 0x11) symbol_table(links, message.data);
            if (message.type == 0x02) dense_links(links, message.data);
            if (message.type == 0x06) link_message(links, message.data);
        }
        for (const Link& child : links) {
            if (child.name.empty() || has_control(child.name) || child.name.find('/') != std::string::npos)
                damaged("hdf5.format", address, "names without slashes and control characters");
            link(path.empty() ? child.name : path + "/" + child.name, child.address, depth + 1);
        }
    }

    // SPEC III.A.1: a version-1 B-tree. Calls leaf(key, child) in order; the key's end is the reader's business.
    template <class F>
    void b_tree_1(uint64_t address, uint64_t type, uint64_t key_size, const F& leaf, int level = -1) {
        Cursor c = cursor(address);
        const Bytes found = c.take(5);
        c.expect(std::ranges::equal(found.first(4), as_bytes("TREE")) && found[4] == type,
                 "a node of a B-tree of type " + std::to_string(type));
        const int depth = static_cast<int>(c.number(1));
        c.expect(level < 0 || depth == level, "a node of level " + std::to_string(level));
        const uint64_t entries = c.number(2);
        c.take(16);  // siblings
        for (uint64_t i = 0; i < entries; ++i) {
            Cursor key = cursor(c.at, key_size);
            c.take(key_size);
            const uint64_t child = c.number(8);
            if (depth == 0)
                leaf(key, child);
            else
                b_tree_1(child, type, key_size, leaf, depth - 1);
        }
    }

    // SPEC IV.A.2.r, III.D (local heap: the names), III.B (nodes), III.C (entries).
    void symbol_table(std::vector<Link>& links, Cursor message) {
        const uint64_t tree = message.number(8);
        Cursor heap = cursor(message.number(8));
        heap.begins("HEAP", 0);
        heap.take(3);
        const uint64_t size = heap.number(8);
        heap.take(8);
        const Bytes names = bytes(heap.number(8), size);
        b_tree_1(tree, 0, 8, [&](Cursor, uint64_t node) {
            Cursor c = cursor(node);
            c.begins("SNOD", 1);
            c.take(1);
            for (uint64_t n = c.number(2); n > 0; --n) {
                const uint64_t name = c.number(8), address = c.number(8), kind = c.number(4);
                c.take(20);
                c.expect(name < names.size(), "a name within the heap");
                const Bytes rest = names.subspan(name);
                const auto end = std::ranges::find(rest, 0);
                c.expect(end != rest.end(), "a name that ends");
                charge(c.at, static_cast<size_t>(end - rest.begin()));
                if (kind != 2) links.push_back({std::string(rest.begin(), end), address});  // 2: a soft link
            }
        });
    }

    // SPEC IV.A.2.g.
    void link_message(std::vector<Link>& links, Cursor c) {
        c.expect(c.number(1) == 1, "a link message of version 1");
        const uint64_t flags = c.number(1);
        const uint64_t type = (flags & 8) != 0 ? c.number(1) : 0;
        c.take(((flags & 4) != 0 ? 8 : 0) + ((flags & 16) != 0 ? 1 : 0));
        const Bytes name = c.take(c.number(uint64_t{1} << (flags & 3)));
        if (type == 0) links.push_back({std::string(name.begin(), name.end()), c.number(8)});
    }

    // SPEC III.A.2: a version-2 B-tree. Calls record(cursor) for each record.
    template <class F>
    void b_tree_2(uint64_t address, uint64_t type, const F& record) {
        Cursor c = cursor(address);
        c.begins("BTHD", 0);
        c.expect(c.number(1) == type, "a B-tree of type " + std::to_string(type));
        const uint64_t node_size = c.number(4), record_size = c.number(2), depth = c.number(2);
        c.take(2);
        const uint64_t root = c.number(8), count = c.number(2);
        c.take(8);
        c.checksum();
        c.expect(record_size > 0 && node_size >= 10 + record_size && depth <= 32, "room for records in a node");
        // Bytes of a pointer to a child: its address, how many records it has and how many its whole subtree has, each
        // in as few bytes as the greatest possible number needs.
        const auto width = [](uint64_t greatest) { return log2(greatest) / 8 + 1; };
        std::vector<uint64_t> most = {(node_size - 10) / record_size};  // by level: in a node; below: in its subtree
        std::vector<uint64_t> below = {most[0]}, total_width = {0};
        for (uint64_t level = 1; level <= depth; ++level) {
            const uint64_t pointer = 8 + width(most[0]) + total_width.back();
            c.expect(node_size >= 10 + pointer, "room for a pointer in a node");
            most.push_back((node_size - 10 - pointer) / (record_size + pointer));
            below.push_back(product(most.back() + 1, below.back(), address) + most.back());
            total_width.push_back(width(below.back()));
        }
        const auto node = [&](const auto& self, uint64_t where, uint64_t n, uint64_t level) -> void {
            Cursor walk = cursor(where);
            walk.begins(level == 0 ? "BTLF" : "BTIN", 0);
            walk.expect(walk.number(1) == type && n <= most[level], "a node of the B-tree's type and size");
            Cursor records = walk;
            walk.take(n * record_size);
            std::vector<std::pair<uint64_t, uint64_t>> children;
            for (uint64_t i = 0; level > 0 && i <= n; ++i) {
                const uint64_t child = walk.number(8), child_count = walk.number(width(most[0]));
                walk.take(total_width[level - 1]);
                children.emplace_back(child, child_count);
            }
            walk.checksum();
            for (uint64_t i = 0; i < n; ++i, records.at += record_size) record(cursor(records.at, record_size));
            for (const auto& [child, child_count] : children) self(self, child, child_count, level - 1);
        };
        if (root != undefined_address) node(node, root, count, depth);
    }

    // SPEC III.G: a fractal heap, whose objects are found by their offset in a space of its own. The blocks that exist:
    // offset -> (address, size) in the file.
    struct Heap {
        uint64_t offset_width, length_width;
        std::map<uint64_t, std::pair<uint64_t, uint64_t>> blocks;
    };

    Heap fractal_heap(uint64_t address) {
        Cursor c = cursor(address);
        c.begins("FRHP", 0);
        c.take(2);
        c.expect(c.number(2) == 0, "a heap without filters", "hdf5.unsupported");
        const uint64_t flags = c.number(1), largest = c.number(4);
        c.take(96);  // huge and tiny objects, statistics
        const uint64_t width = c.number(2), smallest_block = c.number(8), largest_block = c.number(8),
                       bits = c.number(2);
        c.take(2);
        const uint64_t root = c.number(8), root_rows = c.number(2);
        c.checksum();
        c.expect(std::has_single_bit(width) && std::has_single_bit(smallest_block) &&
                     std::has_single_bit(largest_block) && smallest_block <= largest_block && bits <= 64 &&
                     largest > 0 && largest_block <= uint64_t{1} << 32 && root_rows <= 64,
                 "a doubling table of powers of two");
        Heap heap{(bits + 7) / 8, log2(std::min(largest, largest_block)) / 8 + 1, {}};
        const uint64_t direct_rows = log2(largest_block) - log2(smallest_block) + 2;

        const auto direct = [&](uint64_t where, uint64_t size, uint64_t offset) {
            Cursor block = cursor(where);
            block.begins("FHDB", 0);
            block.expect(block.number(8) == address, "a block of this heap");
            block.expect(block.number(heap.offset_width) == offset,
                         "a block of the heap's offset " + std::to_string(offset));
            const Bytes all = bytes(where, size);
            if ((flags & 2) != 0) {  // the checksum is taken with zeros in its own place
                const uint64_t stored = block.number(4);
                std::vector<uint8_t> covered(all.begin(), all.end());
                std::fill_n(covered.begin() + static_cast<ptrdiff_t>(block.at - where - 4), 4, uint8_t{0});
                block.expect(stored == lookup3(covered), "data that match their checksum", "hdf5.checksum");
            }
            heap.blocks[offset] = {where, size};
        };
        // Rows of `width` blocks: two rows of the smallest size, then each row doubles. Beyond direct_rows a block is
        // again such a table.
        const auto indirect = [&](const auto& self, uint64_t where, uint64_t rows, uint64_t offset) -> void {
            Cursor block = cursor(where);
            block.begins("FHIB", 0);
            block.expect(block.number(8) == address, "a block of this heap");
            block.expect(block.number(heap.offset_width) == offset,
                         "a block of the heap's offset " + std::to_string(offset));
            const Bytes children = block.take(rows * width * 8);
            block.checksum();
            for (uint64_t row = 0; row < rows; ++row) {
                const uint64_t power = log2(smallest_block) + (row == 0 ? 0 : row - 1);
                block.expect(power < 64, "a heap below 2^64 bytes");
                for (uint64_t column = 0; column < width; ++column, offset += uint64_t{1} << power) {
                    const uint64_t child = little_endian(children.subspan((row * width + column) * 8, 8));
                    if (child == undefined_address) continue;
                    if (row < direct_rows) {
                        direct(child, uint64_t{1} << power, offset);
                    } else {
                        block.expect(row >= log2(width), "a table smaller than the one it is in");
                        self(self, child, row - log2(width), offset);
                    }
                }
            }
        };
        if (root != undefined_address && root_rows == 0) direct(root, smallest_block, 0);
        if (root != undefined_address && root_rows > 0) indirect(indirect, root, root_rows, 0);
        return heap;
    }

    // SPEC IV.A.2.c: links beyond a handful lie in a heap, as the same messages, and a B-tree knows where.
    void dense_links(std::vector<Link>& links, Cursor message) {
        message.expect(message.number(1) == 0, "a link information message of version 0");
        message.take((message.number(1) & 1) != 0 ? 8 : 0);
        const uint64_t heap_address = message.number(8), tree = message.number(8);
        if (heap_address == undefined_address) return;
        const Heap heap = fractal_heap(heap_address);
        b_tree_2(tree, 5, [&](Cursor c) {  // III.A.2, type 5: a hash of the name, then a heap ID (III.G)
            c.take(4);
            c.expect((c.number(1) & 0xF0) == 0, "a link shorter than 4096 bytes", "hdf5.unsupported");
            const uint64_t offset = c.number(heap.offset_width), length = c.number(heap.length_width);
            auto block = heap.blocks.upper_bound(offset);
            c.expect(block != heap.blocks.begin(), "a link within the heap");
            --block;
            const auto& [address, size] = block->second;
            const uint64_t inside = offset - block->first;
            c.expect(inside < size && length <= size - inside, "a link within a block of the heap");
            link_message(links, cursor(address + inside, length));
        });
    }

    // --- Data sets

    // A data set in the making, and what is read of its header but not kept.
    struct Grid {
        Hdf5Dataset d;
        Shape most;                // the extents to which the data set may grow
        Shape counts;              // chunks in each dimension
        uint64_t all = 1;          // chunks
        bool whole_edges = false;  // chunks that hang over the edge are not filtered
        // Arrays number the chunks row-major, by `most`; if one dimension is unlimited, it counts slowest, whichever it
        // is (H5D__earray_idx in HDF5; SPEC is silent).
        std::vector<size_t> order;  // dimensions, slowest first
        Shape step;                 // step[k]: numbers from one chunk to the next in dimension order[k]
    };

    void dataset(const std::string& path, const std::vector<Message>& header) {
        Grid g;
        Hdf5Dataset& d = g.d;
        d.path = path;
        const auto each = [&](uint64_t type, const auto& read) {
            for (const Message& message : header) {
                if (message.type != type) continue;
                if ((message.flags & 2) != 0)
                    d.unsupported = "its header shares a message with other objects";
                else
                    read(message.data);
            }
        };
        each(0x01, [&](Cursor c) { dataspace(g, c); });
        each(0x03, [&](Cursor c) { datatype(d, c); });
        each(0x07, [&](Cursor) { d.unsupported = "its data are in another file"; });
        each(0x0B, [&](Cursor c) { filter_pipeline(d, c); });
        if (d.element.kind == Hdf5Element::other && d.unsupported.empty())
            d.unsupported = "elements of type " + d.type + " are not supported";
        each(0x04, [&](Cursor c) { fill_value(d, c, 0); });
        each(0x05, [&](Cursor c) {
            const uint64_t version = c.number(1);
            fill_value(d, c, version);
        });
        each(0x08, [&](Cursor c) {
            charge(c.start, sizeof d + path.size());
            if (d.unsupported.empty()) layout(g, c);
        });
        file.datasets.push_back(std::move(d));
    }

    // SPEC IV.A.2.b.
    void dataspace(Grid& g, Cursor c) {
        const uint64_t version = c.number(1), rank = c.number(1), flags = c.number(1), kind = c.number(1);
        c.expect((version == 1 || version == 2) && rank <= 32, "a data space of version 1 or 2, up to 32 dimensions");
        if (version == 1) c.take(4);
        g.d.shape.resize(rank), g.d.elements = 1;
        for (uint64_t& extent : g.d.shape) extent = c.number(8);
        g.most = g.d.shape;
        for (uint64_t& extent : g.most) extent = (flags & 1) != 0 ? c.number(8) : extent;
        if (version == 2 && kind == 2) g.d.shape = g.most = {0};  // no elements, no shape
        const bool none = std::ranges::find(g.d.shape, 0) != g.d.shape.end();
        for (const uint64_t extent : g.d.shape) g.d.elements = none ? 0 : product(g.d.elements, extent, c.at);
        for (size_t k = 0; k < rank && !none; ++k)
            c.expect(g.d.shape[k] <= g.most[k], "extents that are not above the largest allowed");
    }

    // SPEC IV.A.2.d.
    void datatype(Hdf5Dataset& d, Cursor c) {
        const uint64_t head = c.number(1), bits = c.number(3), size = c.number(4);
        const uint64_t type = head & 15, version = head >> 4;
        c.expect(version >= 1 && version <= 5 && size > 0, "a data type of version 1 to 5");
        d.element = {.size = size};
        d.type = type == 6 ? "compound" : type == 9 ? "variable length" : "class " + std::to_string(type);
        if (type == 0) {
            const uint64_t offset = c.number(2), precision = c.number(2);
            if (size > 8 || offset != 0 || precision != 8 * size) return;
            d.element.kind = (bits & 8) != 0 ? Hdf5Element::signed_integer : Hdf5Element::unsigned_integer;
            d.type = ((bits & 8) != 0 ? "int" : "uint") + std::to_string(8 * size);
        } else if (type == 1) {
            const Bytes layout = c.take(12);  // offset, precision; exponent: place, bits; mantissa: place, bits; bias
            constexpr uint8_t single[] = {0, 0, 32, 0, 23, 8, 0, 23, 127, 0, 0, 0};
            constexpr uint8_t twice[] = {0, 0, 64, 0, 52, 11, 0, 52, 255, 3, 0, 0};
            const bool ieee =
                size == 4 ? std::ranges::equal(layout, single) : size == 8 && std::ranges::equal(layout, twice);
            if (!ieee || (bits & 0x70) != 0x20 || bits >> 8 != 8 * size - 1) return;  // order, hidden bit; sign
            d.element.kind = Hdf5Element::floating;
            d.type = "float" + std::to_string(8 * size);
        } else if (type == 3) {
            if ((bits & 15) > 2) return;
            d.element.kind = Hdf5Element::text;
            d.element.padding = static_cast<uint8_t>(bits & 15);
            d.type = "text of " + std::to_string(size) + " bytes";
        } else if (type == 8) {  // an integer type, then the names, then the values; h5py's bool has two
            Cursor base = c;
            if ((base.number(1) & 15) != 0) return;
            datatype(d, c);
            c.take(12);
            const Bytes rest = cursor(c.at, c.end - c.at).take(std::min<uint64_t>(6, c.end - c.at));
            const bool boolean = bits == 2 && size == 1 && std::ranges::equal(rest, as_bytes({"FALSE", 6}));
            if (d.element.kind != Hdf5Element::other) d.type = boolean ? "bool" : "enumeration " + d.type;
            return;
        }
        d.element.big_endian = type < 2 && (bits & 1) != 0 && size > 1;
        if (d.element.big_endian) d.type += ", big-endian";
    }

    // SPEC IV.A.2.e (here version 0) and f.
    void fill_value(Hdf5Dataset& d, Cursor c, uint64_t version) {
        c.expect(version <= 3, "a fill value of version 1 to 3");
        c.take(version == 1 || version == 2 ? 2 : 0);
        const uint64_t flags = version == 0 ? 0 : c.number(1);
        const bool defined = version == 3 ? (flags & 32) != 0 : version < 2 || flags != 0;
        const uint64_t size = defined ? c.number(4) : 0;
        if (size == 0 || !d.unsupported.empty()) return;
        c.expect(size == d.element.size, "a fill value of the data's type");
        d.fill = c.take(size);
    }

    // SPEC IV.A.2.l.
    void filter_pipeline(Hdf5Dataset& d, Cursor c) {
        const uint64_t version = c.number(1), count = c.number(1);
        d.filters.clear();
        c.expect((version == 1 || version == 2) && count <= 32, "a list of up to 32 filters, version 1 or 2");
        if (version == 1) c.take(6);
        for (uint64_t i = 0; i < count; ++i) {
            const uint64_t id = c.number(2), name = version == 1 || id >= 256 ? c.number(2) : 0;
            c.take(2);
            const uint64_t values = c.number(2);
            c.take(version == 1 ? (name + 7) / 8 * 8 : name);
            c.take(4 * values + (version == 1 && values % 2 == 1 ? 4 : 0));
            if (id < 1 || id > 3) d.unsupported = "filter " + std::to_string(id) + " is not supported";
            d.filters.push_back(static_cast<Hdf5Filter>(id));
        }
        if (std::ranges::count(d.filters, Hdf5Filter::deflate) > 1) d.unsupported = "it is compressed twice";
    }

    // SPEC IV.A.2.i, versions 3 and 4; HDF5 2.0 writes 5, which is the same but for the width of a size in an index, and
    // that is told by the index itself.
    void layout(Grid& g, Cursor c) {
        Hdf5Dataset& d = g.d;
        const uint64_t version = c.number(1), kind = c.number(1);
        if (version < 3 || version > 5 || kind > 2) {
            d.unsupported = "its layout is of version " + std::to_string(version) + ", class " + std::to_string(kind);
            return;
        }
        // Deflate shrinks at most 1032-fold; data that are all fill value take nothing.
        const uint64_t limit = std::min<uint64_t>(uint64_t{1} << 34, 1040 * file.bytes.size() + (1 << 26));
        const auto bounded = [&](uint64_t count, uint64_t size) {
            const uint64_t total = product(count, size, c.at);
            c.expect(total <= limit, "at most " + std::to_string(limit) + " bytes in a file so small",
                     "hdf5.too_large");
            return total;
        };
        const uint64_t rank = d.shape.size(), total = bounded(d.elements, d.element.size);
        if (kind < 2) {  // in the header, or in one run elsewhere
            d.filters.clear();
            d.chunk = d.shape;
            d.chunk_bytes = total;
            const uint64_t before = c.number(kind == 0 ? 2 : 8), size = kind == 0 ? before : c.number(8);
            const uint64_t address = kind == 0 ? c.at : before;
            if (total == 0 || address == undefined_address) return;
            c.expect(size >= total, std::to_string(total) + " bytes of data");
            return add(g, {}, {address, total, 0, 0}, c.start);
        }
        const uint64_t flags = version == 3 ? 0 : c.number(1), extents = c.number(1);
        const uint64_t tree = version == 3 ? c.number(8) : 0, width = version == 3 ? 4 : c.number(1);
        c.expect(extents == rank + 1 && width >= 1 && width <= 8, "chunks of as many dimensions as the data");
        d.chunk_bytes = d.element.size;
        for (uint64_t k = 0; k < rank; ++k) {
            d.chunk.push_back(c.number(width));
            c.expect(d.chunk[k] > 0, "chunks that are not empty");
            d.chunk_bytes = product(d.chunk_bytes, d.chunk[k], c.at);
            g.counts.push_back(quotient(d.shape[k], d.chunk[k]));
            g.all = d.elements == 0 ? 0 : product(g.all, g.counts[k], c.at);
        }
        c.expect(c.number(width) == d.element.size, "chunks of the data's elements");
        bounded(g.all, d.chunk_bytes);
        if (d.elements == 0) return;
        g.whole_edges = (flags & 1) != 0;
        if (version == 3) return b_tree_1_index(g, tree);

        const uint64_t index = c.number(1);
        c.expect(index >= 1 && index <= 5, "a chunk index of type 1 to 5");
        Hdf5Chunk single{0, d.chunk_bytes, 0, 0};
        if (index == 1 && (flags & 2) != 0)
            single.size = c.number(8), single.skipped = static_cast<uint32_t>(c.number(4));
        c.take(index < 3 ? 0 : index == 3 ? 1 : index == 4 ? 5 : 6);  // repeated in the index itself
        single.address = c.number(8);
        if (single.address == undefined_address) return;
        if (index == 1) return add(g, Shape(rank, 0), single, c.start);  // VII.A
        if (index == 5) return b_tree_2_index(g, single.address);
        for (size_t k = 0; k < rank; ++k) g.order.insert(g.most[k] == no_limit ? g.order.begin() : g.order.end(), k);
        g.step.assign(rank, 1);
        for (size_t k = rank; k-- > 1;)
            g.step[k - 1] = product(g.step[k], quotient(g.most[g.order[k]], d.chunk[g.order[k]]), c.at);
        if (index == 2) return implicit_index(g, single.address);
        index == 3 ? fixed_array(g, single.address) : extensible_array(g, single.address);
    }

    static uint64_t quotient(uint64_t a, uint64_t b) { return a / b + (a % b != 0 ? 1 : 0); }  // rounded up

    // `place`: which chunk, in each dimension. Those beyond the edge are left over from when the data set was larger.
    void add(Grid& g, const Shape& place, Hdf5Chunk chunk, uint64_t offset) {
        if (chunk.address == undefined_address) return;
        bool partial = false;
        for (size_t k = 0; k < place.size(); ++k) {
            if (place[k] >= g.counts[k]) return;
            chunk.place = chunk.place * g.counts[k] + place[k];
            partial = partial || g.d.shape[k] - place[k] * g.d.chunk[k] < g.d.chunk[k];
        }
        if (g.whole_edges && partial) chunk.skipped = ~0u;
        if (g.d.chunks.size() >= g.all) damaged("hdf5.format", offset, "each chunk once");
        bytes(chunk.address, chunk.size), budget += chunk.size;
        charge(offset, sizeof chunk);
        g.d.chunks.push_back(chunk);
        g.d.stored += chunk.size;
    }

    // SPEC III.A.1, node type 1: a key is the chunk's size, skipped filters, and first element.
    void b_tree_1_index(Grid& g, uint64_t address) {
        Shape place(g.d.shape.size());
        if (address == undefined_address) return;
        b_tree_1(address, 1, 16 + 8 * place.size(), [&](Cursor key, uint64_t chunk) {
            const uint64_t size = key.number(4), skipped = key.number(4);
            for (size_t k = 0; k < place.size(); ++k) {
                const uint64_t first = key.number(8);
                key.expect(first % g.d.chunk[k] == 0, "a chunk that begins at a multiple of its extents");
                place[k] = first / g.d.chunk[k];
            }
            add(g, place, {chunk, size, 0, static_cast<uint32_t>(skipped)}, key.start);
        });
    }

    // SPEC VII.E; III.A.2, types 10 and 11.
    void b_tree_2_index(Grid& g, uint64_t address) {
        Shape place(g.d.shape.size());
        b_tree_2(address, g.d.filters.empty() ? 10 : 11, [&](Cursor c) {
            const Hdf5Chunk chunk = array_element(g, c, c.end - c.at - 8 * place.size());
            for (uint64_t& coordinate : place) coordinate = c.number(8);
            add(g, place, chunk, c.start);
        });
    }

    // An entry of an index, of `size` bytes: the address, and if there are filters the size and those skipped.
    static Hdf5Chunk array_element(const Grid& g, Cursor& c, uint64_t size) {
        const bool filtered = !g.d.filters.empty();
        c.expect(filtered ? size > 12 && size <= 20 : size == 8,
                 "an index of entries of 8 bytes, or with filters 13 to 20");
        const uint64_t address = c.number(8), stored = filtered ? c.number(size - 12) : g.d.chunk_bytes;
        return {address, stored, 0, static_cast<uint32_t>(filtered ? c.number(4) : 0)};
    }

    // Entries `first` to `first + count` from `c` on.
    void elements(Grid& g, Cursor& c, uint64_t size, uint64_t first, uint64_t count) {
        Shape place(g.order.size());
        for (uint64_t i = 0; i < count; ++i) {
            const Hdf5Chunk chunk = array_element(g, c, size);
            uint64_t number = first + i;
            for (size_t k = 0; k < place.size(); number %= g.step[k], ++k) place[g.order[k]] = number / g.step[k];
            add(g, place, chunk, c.start);
        }
    }

    // Pages of entries from `address` on, the last one possibly shorter. `bit`: that of the first page.
    void pages_of_elements(Grid& g, uint64_t address, uint64_t size, uint64_t first, uint64_t count, uint64_t page,
                           Bytes written, uint64_t bit) {
        for (uint64_t p = 0; p < quotient(count, page); ++p, ++bit) {
            const uint64_t here = std::min(page, count - p * page);
            if ((written[bit / 8] << (bit % 8) & 0x80) != 0) {
                Cursor c = cursor(address);
                elements(g, c, size, first + p * page, here);
                c.checksum();
            }
            address += product(here, size, address) + 4;
        }
    }

    // SPEC VII.B: one after the other, no index.
    void implicit_index(Grid& g, uint64_t address) {
        Shape place(g.order.size());
        for (uint64_t i = 0; i < g.all; ++i) {
            for (size_t k = place.size(), rest = i; k-- > 0; rest /= g.counts[k]) place[k] = rest % g.counts[k];
            uint64_t number = 0;
            for (size_t k = 0; k < place.size(); ++k) number += place[g.order[k]] * g.step[k];
            const uint64_t begin = address + product(number, g.d.chunk_bytes, address);
            add(g, place, {begin, g.d.chunk_bytes, 0, 0}, address);
        }
    }

    // The start that an array's header (`header` is 0) and blocks have in common.
    Cursor array_block(const Grid& g, uint64_t address, std::string_view signature, uint64_t header) {
        Cursor c = cursor(address);
        c.begins(signature, 0);
        c.expect(c.number(1) == (g.d.filters.empty() ? 0 : 1), "an index of chunks filtered as the data set says");
        c.expect(header == 0 || c.number(8) == header, "a block of the index at " + std::to_string(header));
        return c;
    }

    // SPEC VII.C.
    void fixed_array(Grid& g, uint64_t address) {
        Cursor c = array_block(g, address, "FAHD", 0);
        const uint64_t size = c.number(1), page_bits = c.number(1), count = c.number(8), block = c.number(8);
        c.checksum();
        c.expect(page_bits < 64, "pages below 2^64 entries");
        if (block == undefined_address) return;
        Cursor data = array_block(g, block, "FADB", address);
        const uint64_t page = uint64_t{1} << page_bits;
        if (count <= page) elements(g, data, size, 0, count);
        const Bytes written = data.take(count <= page ? 0 : quotient(quotient(count, page), 8));  // highest bit first
        data.checksum();
        if (count > page) pages_of_elements(g, data.at, size, 0, count, page, written, 0);
    }

    // SPEC VII.D. Entries lie in the index block (the first few), in data blocks it points to, and in data blocks that
    // secondary blocks point to. Super block u stands for 2^(u/2) data blocks of 2^((u+1)/2) times the least size.
    void extensible_array(Grid& g, uint64_t address) {
        Cursor c = array_block(g, address, "EAHD", 0);
        const uint64_t size = c.number(1), bits = c.number(1), direct = c.number(1), least = c.number(1);
        const uint64_t pointers = c.number(1), page_bits = c.number(1);
        c.take(32);
        const uint64_t used = c.number(8);  // 1 + the highest number stored
        c.take(8);
        const uint64_t block = c.number(8);
        c.checksum();
        c.expect(std::has_single_bit(least) && std::has_single_bit(pointers) && pointers > 1 && log2(least) <= bits &&
                     bits <= 48 && page_bits < 48,
                 "an index of at most 2^48 chunks in blocks of powers of two");
        if (block == undefined_address) return;
        const uint64_t page = uint64_t{1} << page_bits, offset_width = (bits + 7) / 8;
        const uint64_t super_blocks = 1 + bits - log2(least), in_index = std::min(super_blocks, 2 * log2(pointers));
        Cursor index = array_block(g, block, "EAIB", address);
        elements(g, index, size, 0, direct);
        Cursor check = index;  // the whole block before what it points to
        check.take(8 * (2 * (pointers - 1) + super_blocks - in_index));
        check.checksum();
        uint64_t first = direct;
        for (uint64_t u = 0; u < super_blocks && first < used; ++u) {
            const uint64_t blocks = uint64_t{1} << (u / 2), entries = (uint64_t{1} << ((u + 1) / 2)) * least;
            const uint64_t pages = entries > page ? entries / page : 0;
            const bool secondary = u >= in_index;
            const uint64_t super_block = secondary ? index.number(8) : block;
            if (super_block == undefined_address) {
                first += blocks * entries;
                continue;
            }
            Cursor from = secondary ? array_block(g, super_block, "EASB", address) : index;
            Bytes written;  // bits, highest first
            if (secondary) {
                from.take(offset_width);
                written = from.take(blocks * quotient(pages, 8));
                Cursor whole = from;
                whole.take(8 * blocks);
                whole.checksum();
            } else {
                from.expect(pages == 0, "pages only below secondary blocks");
                index.take(8 * blocks);
            }
            for (uint64_t b = 0; b < blocks; ++b, first += entries) {
                const uint64_t data_block = from.number(8);
                if (data_block == undefined_address || first >= used) continue;
                Cursor data = array_block(g, data_block, "EADB", address);
                data.take(offset_width);
                if (pages == 0) elements(g, data, size, first, entries);
                data.checksum();
                if (pages > 0) pages_of_elements(g, data.at, size, first, entries, page, written, b * pages);
            }
        }
    }
};

// Reads everything but the data. `owner` keeps the bytes alive.
inline Hdf5File parse_hdf5(Bytes bytes, std::shared_ptr<const void> owner, const std::string& path) {
    Hdf5File file{path, std::move(owner), bytes, {}};
    Hdf5Parser{file}.superblock();
    return file;
}

inline Hdf5File open_hdf5(const std::string& path) {
    const auto mapped = std::make_shared<const MappedFile>(path);
    return parse_hdf5(mapped->bytes, mapped, path);
}

// ---------------------------------------------------------------------------------------------------------------------
// Writing. The oldest form, which every version of HDF5 reads: superblock 0, groups as symbol tables, data in one run
// each, uncompressed. Data go to the disk as they come; what describes them follows at the end, and the superblock is
// written last.
//
//   Hdf5Writer file("out.hdf5");
//   file.add("actions", {n, 3}, actions);     any vector, array or span; or, for data that come in parts:
//   file.begin<float>("observations", {n, 11}), file.append(part1), file.append(part2), ...
//   file.text("metadata/algorithm", "SAC");
//   file.close();                                                     without it no file appears

class Hdf5Writer {
  public:
    explicit Hdf5Writer(const std::string& path)
        : path_(path),
          temporary_(path + ".tmp"),
          file_(::open(temporary_.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0666)) {
        if (file_.fd < 0) fail_file("file.write", "create it", temporary_);
        put(std::string(superblock_size, '\0'));
    }
    Hdf5Writer(const Hdf5Writer&) = delete;
    Hdf5Writer& operator=(const Hdf5Writer&) = delete;
    ~Hdf5Writer() {
        if (!closed_) ::unlink(temporary_.c_str());
    }

    // T: float, double, int32_t, or uint8_t for booleans (0 or 1). Groups come into being with what they hold.
    template <class T>
    void begin(const std::string& name, const Shape& shape) {
        begin_raw(name, shape, std::string(type_of<T>()), sizeof(T));
    }

    // The next elements, row-major; of the type given to begin.
    template <std::ranges::contiguous_range Range>
    void append(const Range& range) {
        const std::span data(range);
        using T = std::ranges::range_value_t<Range>;
        if (type_ != type_of<T>() || data.size_bytes() > missing_)
            fail("hdf5.shape", "%s: %s: %zu bytes are more than the %zu that its shape leaves, or of another type",
                 path_.c_str(), json_string(name_).c_str(), data.size_bytes(), missing_);
        if constexpr (std::is_same_v<T, uint8_t>)
            if (std::ranges::any_of(data, [](uint8_t flag) { return flag > 1; }))
                fail("hdf5.flag", "%s: %s: a flag is neither 0 nor 1", path_.c_str(), json_string(name_).c_str());
        put({reinterpret_cast<const char*>(data.data()), data.size_bytes()});
        missing_ -= data.size_bytes();
    }

    template <std::ranges::contiguous_range Range>
    void add(const std::string& name, const Shape& shape, const Range& data) {
        begin<std::ranges::range_value_t<Range>>(name, shape);
        append(data);
    }

    // A scalar of fixed length, filled up with NULs.
    void text(const std::string& name, const std::string& text) {
        const size_t size = std::max<size_t>(text.size(), 1);  // HDF5 has no empty types
        begin_raw(name, {}, std::string("\x13\1\0\0", 4) + little(size, 4), size);
        put(text + std::string(size - text.size(), '\0'));
        missing_ = 0;
    }

    void close() {
        finish();
        const std::string root = group(root_);
        const std::string start = "\x89HDF\r\n\x1a\n" + std::string(5, '\0') + "\x08\x08" + '\0' + little(leaf_k_, 2) +
                                  little(tree_k, 2) + little(0, 4 + 8) + none + little(position_, 8) + none +
                                  little(0, 8) + root;  // SPEC II.A, version 0
        flush();
        if (::lseek(file_.fd, 0, SEEK_SET) != 0) fail_file("file.write", "go back to its start", temporary_);
        write_all(file_, start, temporary_);
        sync_to_disk(file_, temporary_);
        if (::rename(temporary_.c_str(), path_.c_str()) != 0)
            fail_file("file.write", "rename its temporary file to it", path_);
        closed_ = true;
        sync_folder_of(path_);
    }

  private:
    struct Node {
        std::map<std::string, Node> children;  // of a group
        std::string header;                    // of a data set
    };

    static constexpr size_t superblock_size = 96, tree_k = 16, buffer_size = 1 << 20;
    inline static const std::string none = std::string(8, '\xFF');  // the undefined address

    template <class T>  // SPEC IV.A.2.d: class, bits, size, then what the class needs
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
        for (char& byte : bytes) byte = static_cast<char>(value), value >>= 8;
        return bytes;
    }
    void put(std::string_view bytes) {
        if (buffer_.size() + bytes.size() > buffer_size) flush();
        if (bytes.size() > buffer_size)
            write_all(file_, bytes, temporary_);
        else
            buffer_ += bytes;
        position_ += bytes.size();
    }
    void flush() {
        write_all(file_, buffer_, temporary_);
        buffer_.clear();
    }
    uint64_t place(std::string_view bytes) {  // at a multiple of 8
        put(std::string((8 - position_ % 8) % 8, '\0'));
        put(bytes);
        return position_ - bytes.size();
    }

    // SPEC IV.A.1.a: an object header. Messages are filled up to a multiple of 8 bytes.
    static std::string header(const std::vector<std::pair<uint64_t, std::string>>& messages) {
        std::string body;
        for (const auto& [type, data] : messages) {
            const size_t size = (data.size() + 7) / 8 * 8;
            body += little(type, 2) + little(size, 2) + little(0, 4) + data + std::string(size - data.size(), '\0');
        }
        return little(1, 2) + little(messages.size(), 2) + little(1, 4) + little(body.size(), 4) + little(0, 4) + body;
    }

    void begin_raw(const std::string& name, const Shape& shape, const std::string& type, size_t element_size) {
        finish();
        name_ = name;
        type_ = type;
        missing_ = element_size;
        std::string space = little(1, 1) + little(shape.size(), 1) + little(0, 6);
        for (const uint64_t extent : shape) {
            if (__builtin_mul_overflow(missing_, extent, &missing_) || shape.size() > 32)
                fail("hdf5.shape", "%s: %s: shape %s is too large", path_.c_str(), json_string(name).c_str(),
                     shape_text(shape).c_str());
            space += little(extent, 8);
        }
        Node* node = &root_;
        for (size_t at = 0; at <= name.size();) {
            const size_t end = std::min(name.find('/', at), name.size());
            const bool last = end == name.size();
            const std::string part = name.substr(at, end - at);
            Node& child = node->children[part];
            if (part.empty() || part == "." || !is_utf8(part) || has_control(part) || !child.header.empty() ||
                (last && !child.children.empty()) || node->children.size() > 65535)
                fail("hdf5.name", "%s: %s cannot name a data set: a part of it is in use or is no name", path_.c_str(),
                     json_string(name).c_str());
            leaf_k_ = std::max(leaf_k_, (node->children.size() + 1) / 2);
            node = &child;
            at = end + 1;
        }
        const uint64_t address = missing_ == 0 ? undefined_address : place("");
        node->header = header({{0x01, space},                                                // SPEC IV.A.2.b
                               {0x03, type},                                                 // IV.A.2.d
                               {0x05, little(0x01'02'02'02, 4) + little(0, 4)},              // IV.A.2.f: zeros
                               {0x08, "\3\1" + little(address, 8) + little(missing_, 8)}});  // IV.A.2.i
    }

    void finish() const {
        if (missing_ > 0)
            fail("hdf5.shape", "%s: %s: %zu bytes fewer were given than its shape has", path_.c_str(),
                 json_string(name_).c_str(), missing_);
    }

    // Writes what the group holds, then itself: SPEC III.D (names), III.B (entries), III.A.1 (a tree of one leaf),
    // IV.A.2.r. Gives its own entry but for the name (III.C).
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
        const uint64_t heap =
            place("HEAP" + little(0, 4) + little(names.size(), 8) + little(1, 8) + little(segment, 8));
        const uint64_t leaf = place("SNOD" + little(1, 2) + little(count, 2) + entries);
        std::string keys = little(0, 8) + little(leaf, 8) + little(last_name, 8);
        keys.resize(8 * (4 * tree_k + 1));
        const uint64_t tree = place("TREE" + little(0, 2) + little(count > 0, 2) + none + none + keys);
        const uint64_t address = place(header({{0x11, little(tree, 8) + little(heap, 8)}}));
        return little(address, 8) + little(1, 8) + little(tree, 8) + little(heap, 8);
    }

    std::string path_, temporary_;
    FileDescriptor file_;
    std::string buffer_;
    uint64_t position_ = 0;  // bytes put
    bool closed_ = false;
    Node root_;
    size_t leaf_k_ = 4;        // half the number of entries in a leaf of any group's tree: one leaf must do
    std::string name_, type_;  // of the data set being written
    size_t missing_ = 0;       // bytes
};
