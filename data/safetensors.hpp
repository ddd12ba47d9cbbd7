// safetensors.hpp: bytes to and from disk. Whole files, logs that only grow, and safetensors, the format of models,
// checkpoints and golden vectors (any version of the `safetensors` Python package opens them).
// Promises: equal contents give equal bytes; no input crashes the reader or makes it allocate out of proportion; a
// write that fails leaves the old file as it was; of two processes that write one path, the last to finish wins; every
// error names the file and the tensor or offset. Leaves out: dtypes that nothing here needs, memory mapping, big-endian
// machines.
#pragma once

#include <dirent.h>
#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <bit>
#include <cerrno>
#include <charconv>
#include <filesystem>
#include <optional>
#include <ranges>
#include <span>
#include <sstream>
#include <string_view>

#include "../nn.hpp"  // and with it the other standard headers

static_assert(std::endian::native == std::endian::little, "tensors are copied as they lie in memory");
static_assert(sizeof(size_t) == 8, "sizes in bytes are size_t");

// Returns the parts, one after the other: texts, whole numbers, and other numbers to six digits.
std::string text_of(const auto&... parts) {
    std::ostringstream text;
    text.exceptions(std::ios::badbit);  // or it would swallow the failure of an allocation and leave out the rest
    (text << ... << parts);
    return text.str();
}

// Fails unless the condition holds. The sentence is text_of(parts...).
void require(bool holds, const char* id, const auto&... parts) {
    if (!holds) throw Error(id, text_of(parts...));
}

// ---------------------------------------------------------------------------------------------------------------------
// Files

// Fails with the reason that errno holds, so the caller calls it at once after the failure.
[[noreturn]] inline void fail_file(const char* id, const char* action, const std::string& path) {
    fail(id, "%s: cannot %s: %s", path.c_str(), action, std::strerror(errno));
}

// An open file. Its functions fail with file.read and file.write.
struct File {
    std::string path;
    int fd;

    // Errors: `id`. O_NONBLOCK: opening a named pipe must not wait for its other end.
    File(const std::string& name, int flags, const char* id, const char* action)
        : path(name),
          fd(::open(name.c_str(), flags | O_CLOEXEC | O_NONBLOCK, 0666)) {
        if (fd < 0) fail_file(id, action, path);
    }
    File(File&&) = delete;  // nor are there copies
    ~File() { ::close(fd); }

    // Returns the size in bytes of a regular file. Errors: file.not_regular for a folder, pipe or device.
    size_t size() const {
        struct stat status {};
        if (::fstat(fd, &status) != 0) fail_file("file.read", "ask for its size", path);
        require(S_ISREG(status.st_mode), "file.not_regular", path, ": is not a regular file; give a file's path");
        return static_cast<size_t>(status.st_size);
    }
    // Reads the `count` bytes at an offset, or fewer where the file ends or the system says so. Returns how many.
    size_t read_at(size_t at, char* to, size_t count) const {
        ssize_t got = 0;
        do got = ::pread(fd, to, count, static_cast<off_t>(at));
        while (got < 0 && errno == EINTR);
        if (got < 0) fail_file("file.read", "read it", path);
        return static_cast<size_t>(got);
    }
    // Makes `bytes` hold the file's first `count` bytes, of which it may hold the first ones already.
    // Errors: file.too_large, before anything is allocated; file.read.
    void read(std::string& bytes, size_t count, size_t limit = size_t{1} << 36) const {
        require(count <= limit, "file.too_large", path, ": has ", count, " bytes, at most ", limit, " are read");
        size_t done = bytes.size(), got = 0;
        for (bytes.resize(count); done < count; done += got) {
            got = read_at(done, bytes.data() + done, count - done);
            require(got > 0, "file.read", path, ": shrank while it was read (", count, " bytes); try again");
        }
    }
    // This is the only call of write(), which may be interrupted and may take fewer bytes than it was given (POSIX).
    void write(std::string_view bytes) const {
        while (!bytes.empty()) {
            const ssize_t count = ::write(fd, bytes.data(), bytes.size());
            if (count < 0 && errno == EINTR) continue;
            if (count < 0) fail_file("file.write", "write it", path);
            bytes.remove_prefix(static_cast<size_t>(count));
        }
    }
    void sync() const {
        if (::fsync(fd) != 0) fail_file("file.write", "flush it to the disk", path);
    }
};

// Returns the whole file. `limit` (bytes) is checked before anything is allocated. Errors: file.open, file.not_regular,
// file.too_large, file.read.
inline std::string read_file(const std::string& path, size_t limit = size_t{1} << 36) {
    const File file(path, O_RDONLY, "file.open", "open it");
    std::string bytes;
    file.read(bytes, file.size(), limit);
    return bytes;
}

// Returns the path of the regular file, there or not yet, that writing to `path` makes or replaces: symbolic links are
// followed. Errors: file.not_regular for a folder, pipe or device, file.write for links in a circle.
inline std::string written_path(const std::string& path) {
    namespace fs = std::filesystem;
    std::error_code none;  // what cannot be looked at is not there; creating it then says why
    fs::path at = path;
    for (int links = 0; fs::is_symlink(at, none); ++links) {
        require(links < 40, "file.write", path, ": its symbolic links lead in a circle");
        at = at.parent_path() / fs::read_symlink(at, none);
    }
    require(!fs::exists(at, none) || fs::is_regular_file(at, none), "file.not_regular", path,
            ": is not a regular file; it is left as it is, give another path to write to");
    return at;
}

// Errors: file.input, if writing to `out` would replace the file `input`; those of written_path().
inline void require_other_file(const std::string& out, const std::string& input) {
    std::error_code none;
    require(!std::filesystem::equivalent(written_path(out), input, none), "file.input", out, ": is the file ", input,
            " that is read; give another path to write to");
}

// A file that appears as a whole: other programs see the old file or the complete new one. Bytes go to PATH.N.tmp,
// where N is the first number from the process's own on that is free, until commit() renames it; without commit() the
// temporary is removed. One that a killed process leaves is nobody's: see remove_temporaries.
// Errors: file.write, those of written_path().
struct AtomicFile {
    std::string path, target = written_path(path), temporary = free_name(target);
    File file{temporary, O_WRONLY | O_CREAT | O_EXCL, "file.write", "create it"};
    bool renamed = false;

    explicit AtomicFile(const std::string& path_) : path(path_) { file.path = path; }
    static std::string free_name(const std::string& beside) {
        const auto name = [&](pid_t n) { return beside + "." + std::to_string(n) + ".tmp"; };
        std::error_code none;
        pid_t n = ::getpid();
        while (std::filesystem::exists(name(n), none)) ++n;
        return name(n);
    }
    ~AtomicFile() {
        if (!renamed) ::unlink(temporary.c_str());
    }
    void write(std::string_view bytes) const { file.write(bytes); }
    void commit() {
        file.sync();
        if (::rename(temporary.c_str(), target.c_str()) != 0)
            fail_file("file.write", "rename its temporary file to it", path);
        renamed = true;
        // Until the folder is flushed, a power cut may bring the old name back.
        const std::string parent = target.substr(0, target.find_last_of('/') + 1);
        const File folder(parent.empty() ? "." : parent, O_RDONLY | O_DIRECTORY, "file.write",
                          "open the folder to flush it");
        // EINVAL: this file system has no such operation.
        if (::fsync(folder.fd) != 0 && errno != EINVAL)
            fail_file("file.write", "flush the folder to the disk", folder.path);
    }
};

inline void write_file_atomic(const std::string& path, std::string_view bytes) {
    AtomicFile file(path);
    file.write(bytes);
    file.commit();
}

// Whether there is a file or folder of this name; no for a name that none can have.
inline bool is_there(const std::string& path) {
    std::error_code error;
    return std::filesystem::exists(path, error);
}

// Removes the temporaries that killed processes left in a folder in which no other process writes now.
inline void remove_temporaries(const std::string& folder) {
    std::error_code none;
    std::vector<std::filesystem::path> found;
    // Not by a directory_iterator: that of GCC 12 ends the process when an allocation fails.
    struct Close {
        void operator()(DIR* open) const { ::closedir(open); }
    };
    const std::unique_ptr<DIR, Close> listing(::opendir(folder.c_str()));
    while (const dirent* entry = listing ? ::readdir(listing.get()) : nullptr) {
        const std::filesystem::path name = entry->d_name;
        const std::string number = name.stem().extension();  // of NAME.N.tmp: ".N"
        const bool digits = number.size() > 1 && number.find_first_not_of("0123456789", 1) == std::string::npos;
        if (digits && name.extension() == ".tmp") found.push_back(folder / name);
    }
    for (const std::filesystem::path& temporary : found) std::filesystem::remove(temporary, none);
}

// A log that grows. write() gives text to the system at once (no buffer), sync() brings it to the disk. A checkpoint
// notes the size after sync(); a run that continues from the checkpoint gives that size to truncate_file first.
struct AppendFile : File {
    explicit AppendFile(const std::string& name)
        : File(name, O_WRONLY | O_CREAT | O_APPEND, "file.open", "open it for writing") {
        size();
    }
};

// Drops what a log gained after the checkpoint that noted `size` bytes. Errors: file.open, file.shorter, file.write.
inline void truncate_file(const std::string& path, size_t size) {
    const File file(path, O_WRONLY, "file.open", "open it for writing");
    const size_t found = file.size();
    require(found >= size, "file.shorter", path, ": has ", found, " bytes, the checkpoint was saved when it had ", size,
            "; restore it or start anew");
    if (::ftruncate(file.fd, static_cast<off_t>(size)) != 0) fail_file("file.write", "shorten it", path);
    file.sync();
}

// ---------------------------------------------------------------------------------------------------------------------
// CRC-32 as in zlib and PNG: polynomial 0x04C11DB7, bits reversed, inverted before and after. It finds every single
// changed bit and every burst of up to 32 bits.

// crc_tables[k][b]: the effect of byte b followed by k zero bytes, so that eight bytes take eight independent look-ups.
inline constexpr auto crc_tables = [] {
    std::array<std::array<uint32_t, 256>, 8> tables{};
    for (uint32_t byte = 0; byte < 256; ++byte) {
        uint32_t& crc = tables[0][byte] = byte;
        for (int bit = 0; bit < 8; ++bit) crc = (crc >> 1) ^ ((crc & 1) != 0 ? 0xEDB88320u : 0u);
    }
    for (size_t k = 1; k < 8; ++k)
        for (size_t byte = 0; byte < 256; ++byte)
            tables[k][byte] = (tables[k - 1][byte] >> 8) ^ tables[0][tables[k - 1][byte] & 255];
    return tables;
}();

// `before` continues a checksum: crc32(b, crc32(a)) is the checksum of a followed by b.
inline uint32_t crc32(std::string_view bytes, uint32_t before = 0) {
    uint32_t crc = ~before;
    while (bytes.size() >= 8) {
        uint64_t word;
        std::memcpy(&word, bytes.data(), 8);
        word ^= crc;
        crc = 0;
        for (size_t k = 0; k < 8; ++k) crc ^= crc_tables[7 - k][word >> (8 * k) & 255];
        bytes.remove_prefix(8);
    }
    for (const char byte : bytes) crc = (crc >> 8) ^ crc_tables[0][(crc ^ static_cast<uint8_t>(byte)) & 255];
    return ~crc;
}

inline std::string hex8(uint32_t value) {
    char digits[9];
    std::snprintf(digits, sizeof digits, "%08x", value);
    return digits;
}

// ---------------------------------------------------------------------------------------------------------------------
// Text

// Control characters must not reach a terminal.
inline bool is_control(char c) { return (c >= 0 && c < 0x20) || c == 0x7F; }
inline bool has_control(std::string_view text) { return std::ranges::any_of(text, is_control); }

// Returns `text` as a JSON string with its quotes.
inline std::string json_string(std::string_view text) {
    std::string out = "\"";
    for (const char c : text) {
        if (c == '"' || c == '\\') out += '\\';
        out += is_control(c) ? "\\u" + hex8(static_cast<uint32_t>(c)).substr(4) : std::string(1, c);
    }
    return out + "\"";
}

// True for UTF-8 as RFC 3629 defines it: no overlong forms, no surrogates, nothing above U+10FFFF.
inline bool is_utf8(std::string_view text) {
    constexpr uint32_t least[] = {0, 0x80, 0x800, 0x10000};  // by the number of bytes that follow the first
    for (size_t i = 0; i < text.size();) {
        const auto first = static_cast<uint8_t>(text[i++]);
        if (first < 0x80) continue;
        const int more = first >= 0xF0 ? 3 : first >= 0xE0 ? 2 : 1;
        uint32_t code = first & (0x3Fu >> more);
        for (int k = 0; k < more; ++k, ++i) {
            if (i >= text.size() || (text[i] & 0xC0) != 0x80) return false;
            code = code << 6 | (text[i] & 0x3F);
        }
        const bool surrogate = code >> 11 == 0xD800 >> 11;
        if (first < 0xC0 || first >= 0xF8 || code < least[more] || code > 0x10FFFF || surrogate) return false;
    }
    return true;
}

// ---------------------------------------------------------------------------------------------------------------------
// Tensors

// Returns the number that 16 bits stand for as IEEE 754's binary16: sign, 5 bits of exponent, 10 of fraction.
inline float half_value(uint16_t bits) {
    const int exponent = bits >> 10 & 31, fraction = bits & 1023;
    const int significand = exponent == 0 ? fraction : 1024 + fraction;
    float magnitude = std::ldexp(static_cast<float>(significand), std::max(exponent, 1) - 25);
    if (exponent == 31) magnitude = fraction == 0 ? INFINITY : NAN;
    return bits >> 15 != 0 ? -magnitude : magnitude;
}

// The same for bfloat16: the upper half of a float.
inline float bf16_value(uint16_t bits) { return std::bit_cast<float>(uint32_t{bits} << 16); }

enum class DType : uint8_t { F32, F64, F16, BF16, U8, U32, U64, I32, I64, BOOL };
struct DTypeInfo {
    const char* name;
    size_t size;  // bytes of one element
};
inline constexpr DTypeInfo dtypes[] = {{"F32", 4}, {"F64", 8}, {"F16", 2}, {"BF16", 2}, {"U8", 1},
                                       {"U32", 4}, {"U64", 8}, {"I32", 4}, {"I64", 8},  {"BOOL", 1}};
inline const DTypeInfo& about(DType dtype) { return dtypes[static_cast<size_t>(dtype)]; }

// A DType's name is a letter for the kind and the number of bits. For a type that has none this does not compile.
template <class T>
consteval DType dtype_of() {
    constexpr char kind = std::is_floating_point_v<T> ? 'F' : std::is_signed_v<T> ? 'I' : 'U';
    size_t i = 0;
    while (dtypes[i].name[0] != kind || dtypes[i].size != sizeof(T)) ++i;
    return static_cast<DType>(i);
}

using Shape = std::vector<uint64_t>;  // {} is a scalar: one element

// Returns "[2, 3]"; of more than 16 extents only the first ones.
inline std::string shape_text(const Shape& shape) {
    std::string text = "[";
    for (const uint64_t extent : std::span(shape).first(std::min<size_t>(shape.size(), 16)))
        text += (text.size() > 1 ? ", " : "") + std::to_string(extent);
    return text + (shape.size() > 16 ? ", ... of " + std::to_string(shape.size()) : "") + "]";
}

// Returns the bytes of a tensor, or nothing if they do not fit 64 bits.
inline std::optional<size_t> byte_size(const Shape& shape, DType dtype) {
    size_t size = about(dtype).size;
    for (const uint64_t extent : shape)
        if (__builtin_mul_overflow(size, extent, &size)) return {};
    return size;
}

// Returns the place that a message begins with. A damaged file's name may be of any length.
inline std::string tensor_place(const std::string& path, const std::string& name) {
    return path + ": tensor " + json_string(name.substr(0, 80));
}

// Errors: safetensors.name, so that every name can be printed on a terminal as it is.
inline void check_name(const std::string& name, const std::string& path) {
    require(name != "__metadata__" && !has_control(name), "safetensors.name", tensor_place(path, name),
            ": cannot have this name: no control characters, not __metadata__");
}

struct StoredTensor {
    std::string name;
    DType dtype;
    Shape shape;
    size_t begin, size;  // bytes; `begin` counts from TensorFile::data_start
};

// The contents of one file, read or to be written. The tensors cover `buffer` from data_start to its end, in order,
// without a gap: `buffer` is the whole file if it was read (data_start = 8 + N), else the data alone (data_start = 0).
struct TensorFile {
    std::string path = "(not yet saved)";         // for messages
    std::map<std::string, std::string> metadata;  // sorted, without the two checksum entries
    std::vector<StoredTensor> tensors;
    std::map<std::string, size_t> index;  // name -> place in `tensors`
    std::string buffer;
    size_t data_start = 0;
    bool has_checksums = false;  // the file had both checksum entries, and they held

    std::string_view data() const { return std::string_view(buffer).substr(data_start); }
    std::string_view bytes(const StoredTensor& tensor) const { return data().substr(tensor.begin, tensor.size); }
    bool has(const std::string& name) const { return index.contains(name); }

    // Errors: safetensors.missing.
    const StoredTensor& find(const std::string& name) const {
        const auto found = index.find(name);
        require(found != index.end(), "safetensors.missing", tensor_place(path, name), ": is not among the ",
                tensors.size(), " tensors; is it a file of this kind?");
        return tensors[found->second];
    }

    // Returns a metadata entry. Errors: safetensors.missing.
    const std::string& text(const std::string& key) const {
        const auto found = metadata.find(key);
        require(found != metadata.end(), "safetensors.missing", path, ": has no metadata entry ", json_string(key),
                "; is it a file of this kind?");
        return found->second;
    }

    // Copies `values` (vector, span or array; row-major) to the end. A scalar: add("step", {}, std::array{n}).
    // Errors: safetensors.name, safetensors.shape, safetensors.duplicate_name.
    void add(const std::string& name, const Shape& shape, const std::ranges::contiguous_range auto& values) {
        const std::span given(std::ranges::data(values), std::ranges::size(values));
        constexpr DType dtype = dtype_of<typename decltype(given)::value_type>();
        const std::string place = tensor_place(path, name);
        check_name(name, path);
        require(byte_size(shape, dtype) == given.size_bytes(), "safetensors.shape", place, ": has shape ",
                shape_text(shape), " and was given ", given.size(), " elements");
        require(index.emplace(name, tensors.size()).second, "safetensors.duplicate_name", place, ": was added twice");
        tensors.push_back({name, dtype, shape, data().size(), given.size_bytes()});
        if (!given.empty()) buffer.append(reinterpret_cast<const char*>(given.data()), given.size_bytes());
    }

    // Errors: safetensors.shape, also if the caller expects another number of elements than the file has.
    void require_shape(const StoredTensor& tensor, const Shape& shape, size_t elements) const {
        const bool same = tensor.shape == shape && tensor.size == elements * about(tensor.dtype).size;
        require(same, "safetensors.shape", tensor_place(path, tensor.name), " has shape ", shape_text(tensor.shape),
                ", expected ", shape_text(shape), " (", elements, " elements); made with other settings?");
    }

    // Copies tensor `name` to `out`. Errors: safetensors.missing; safetensors.dtype and safetensors.shape if the type,
    // the shape or the number of elements is not the stored one.
    template <class T>
    void read_into(std::span<T> out, const std::string& name, const Shape& shape) const {
        const StoredTensor& tensor = find(name);
        const std::string place = tensor_place(path, name);
        require(tensor.dtype == dtype_of<T>(), "safetensors.dtype", place, " has dtype ", about(tensor.dtype).name,
                ", expected ", about(dtype_of<T>()).name);
        require_shape(tensor, shape, out.size());
        if (!out.empty()) std::memcpy(out.data(), bytes(tensor).data(), tensor.size);  // the file need not be aligned
    }

    template <class T>
    std::vector<T> get(const std::string& name, const Shape& shape) const {
        std::vector<T> out(find(name).size / sizeof(T));
        read_into(std::span(out), name, shape);
        return out;
    }

    // Returns a tensor's numbers, whatever their type in the file. A double holds all but large whole numbers exactly,
    // a long double every one.
    template <class Number = double>
    std::vector<Number> numbers(const StoredTensor& tensor) const {
        const std::string_view from = bytes(tensor);
        const auto all = [&](auto stored, const auto& value) {
            std::vector<Number> out;
            out.reserve(from.size() / sizeof stored);
            for (size_t at = 0; at < from.size(); at += sizeof stored) {
                std::memcpy(&stored, &from[at], sizeof stored);
                out.push_back(static_cast<Number>(value(stored)));
            }
            return out;
        };
        constexpr std::identity same;
        if (tensor.dtype == DType::F32) return all(0.0f, same);
        if (tensor.dtype == DType::F64) return all(0.0, same);
        if (tensor.dtype == DType::F16) return all(uint16_t{0}, half_value);
        if (tensor.dtype == DType::BF16) return all(uint16_t{0}, bf16_value);
        if (tensor.dtype == DType::U32) return all(uint32_t{0}, same);
        if (tensor.dtype == DType::U64) return all(uint64_t{0}, same);
        if (tensor.dtype == DType::I32) return all(int32_t{0}, same);
        if (tensor.dtype == DType::I64) return all(int64_t{0}, same);
        return all(uint8_t{0}, same);  // U8, BOOL
    }

    // Returns a tensor of any kind of float, each number rounded to the nearest float. Errors: those of read_into() but
    // for these types; safetensors.range for a finite number beyond those of float.
    std::vector<float> get_floats(const std::string& name, const Shape& shape) const {
        const StoredTensor& tensor = find(name);
        const bool other_float = tensor.dtype > DType::F32 && tensor.dtype <= DType::BF16;
        if (!other_float) return get<float>(name, shape);
        const std::vector<double> values = numbers(tensor);
        require_shape(tensor, shape, values.size());
        for (size_t i = 0; i < values.size(); ++i)
            require(!std::isfinite(values[i]) || std::isfinite(static_cast<float>(values[i])), "safetensors.range",
                    tensor_place(path, name), ": element ", i, " is ", values[i],
                    ", beyond the numbers of float, to which ", about(tensor.dtype).name, " is converted");
        return {values.begin(), values.end()};
    }
};

// ---------------------------------------------------------------------------------------------------------------------
// The format
//
//   offset  0                8                                  8 + N                            end of file
//           +----------------+----------------------------------+--------------------------------+
//           | N, u64 little- | JSON in UTF-8, then spaces up to | data: little-endian, row-major |
//           | endian, <= 1e8 | a multiple of 8 bytes            | every byte belongs to 1 tensor |
//           +----------------+----------------------------------+--------------------------------+
//   JSON:   {"__metadata__":{"crc32.header":"89abcdef","crc32.tensors":"0123456789abcdef...","KEY":"TEXT",...},
//            "NAME":{"dtype":"F32","shape":[2,3],"data_offsets":[BEGIN,END]},...}        offsets count from 8 + N
//   types:  KEY, TEXT and NAME are strings; extents and offsets are whole numbers below 2^64
//
// Two metadata entries are this program's own. crc32.tensors: 8 hex digits for each tensor, in the order of the data.
// crc32.header: the CRC-32 of bytes 0 to 8 + N, its own eight digits (bytes 41 to 48) taken as 00000000. A file with
// neither was made elsewhere and is read unchecked, but for checkpoints, which are refused; otherwise both must hold,
// so no single changed bit goes unnoticed.

inline constexpr size_t header_limit = 100'000'000;  // bytes; the same as in the original implementation
inline constexpr std::string_view header_start = "{\"__metadata__\":{\"crc32.header\":\"";
inline constexpr size_t crc_at = 8 + header_start.size();  // 41

// Returns the digits of the CRC-32 of bytes 0 to 8 + N, its own digits taken as zeros.
inline std::string header_checksum(std::string_view start) {
    const uint32_t before = crc32("00000000", crc32(start.substr(0, crc_at)));
    return hex8(crc32(start.substr(crc_at + 8), before));
}

// Returns bytes 0 to 8 + N of the file. Errors: safetensors.metadata.
inline std::string file_start(const TensorFile& file) {
    std::string out = std::string(8, '\0') + std::string(header_start) + "00000000\",\"crc32.tensors\":\"";
    for (const StoredTensor& tensor : file.tensors) out += hex8(crc32(file.bytes(tensor)));
    out += "\"";
    for (const auto& [key, text] : file.metadata) out += "," + json_string(key) + ":" + json_string(text);
    out += "}";
    for (const StoredTensor& tensor : file.tensors) {
        out += "," + json_string(tensor.name) + ":{\"dtype\":\"" + about(tensor.dtype).name + "\",\"shape\":[";
        for (size_t i = 0; i < tensor.shape.size(); ++i) out += (i > 0 ? "," : "") + std::to_string(tensor.shape[i]);
        out += text_of("],\"data_offsets\":[", tensor.begin, ",", tensor.begin + tensor.size, "]}");
    }
    out += "}";
    out.resize((out.size() + 7) / 8 * 8, ' ');
    const size_t length = out.size() - 8;
    const bool reserved = file.metadata.contains("crc32.header") || file.metadata.contains("crc32.tensors");
    require(length <= header_limit && !reserved && is_utf8(std::string_view(out).substr(8)), "safetensors.metadata",
            file.path, ": names and metadata (", length, " bytes) must be UTF-8, below 100 MB, without crc32.*");
    std::memcpy(out.data(), &length, 8);
    out.replace(crc_at, 8, header_checksum(out));
    return out;
}

// Writes the file in two pieces: several hundred megabytes of data are not copied once more.
inline void write_safetensors(const std::string& path, const TensorFile& file) {
    AtomicFile out(path);
    out.write(file_start(file));
    out.write(file.data());
    out.commit();
}

// Reads the JSON. Nothing here recurses: a header is objects two deep, read by nested calls, and anything else is
// refused (safetensors.json).
struct HeaderReader {
    std::string_view file;  // bytes 0 to 8 + N
    const std::string& path;
    size_t at = 8;  // next byte; messages give it as the offset in the file

    void expect(bool holds, std::string_view what) const {
        require(holds, "safetensors.json", path, ": offset ", at, ": expected ", what,
                "; the file is damaged or is not safetensors");
    }
    void skip_space() { at = std::min(file.find_first_not_of(" \t\r\n", at), file.size()); }
    bool take(char c) {
        skip_space();
        const bool found = at < file.size() && file[at] == c;
        at += found ? 1 : 0;
        return found;
    }
    void need(char c) { expect(take(c), {&c, 1}); }

    // Returns what an escape stands for, as UTF-8. Surrogate pairs are refused: other programs write characters above
    // U+FFFF as UTF-8.
    std::string escape() {
        const size_t which = std::string_view("\"\\/bfnrtu").find(at < file.size() ? file[at++] : '?');
        expect(which != std::string_view::npos, "one of \" \\ / b f n r t u after \\");
        if (which < 8) return {"\"\\/\b\f\n\r\t"[which]};
        uint32_t code = 0;
        const std::string_view digits = file.substr(at, 4);
        const char* end = digits.data() + digits.size();
        expect(std::from_chars(digits.data(), end, code, 16).ptr == end && digits.size() == 4, "4 hex digits");
        expect(code >> 11 != 0xD800 >> 11, "no surrogate");
        at += 4;
        const char last = static_cast<char>(0x80 | (code & 0x3F));
        if (code < 0x80) return {static_cast<char>(code)};
        if (code < 0x800) return {static_cast<char>(0xC0 | code >> 6), last};
        return {static_cast<char>(0xE0 | code >> 12), static_cast<char>(0x80 | (code >> 6 & 0x3F)), last};
    }
    std::string string() {
        need('"');
        std::string out;
        while (true) {
            expect(at < file.size() && static_cast<uint8_t>(file[at]) >= 0x20, "the end of a string");
            const char c = file[at++];
            if (c == '"') return out;
            out += c == '\\' ? escape() : std::string(1, c);
        }
    }
    uint64_t integer() {
        skip_space();
        uint64_t value = 0;
        const char* begin = file.data() + at;
        const auto [end, error] = std::from_chars(begin, file.data() + file.size(), value);
        expect(error == std::errc(), "a whole number from 0 to 2^64 - 1");
        expect(*begin != '0' || end - begin == 1, "a number without leading zeros");
        at += static_cast<size_t>(end - begin);
        return value;
    }
    // Reads items separated by commas between two brackets.
    void list(char open, char close, const auto& item) {
        need(open);
        if (take(close)) return;
        do item();
        while (take(','));
        need(close);
    }
    Shape integers() {
        Shape out;
        list('[', ']', [&] { out.push_back(integer()); });
        return out;
    }
    // Calls member(key) with the reader at each value; member returns false if the key came before.
    void object(const auto& member) {
        list('{', '}', [&] {
            const std::string key = string();
            need(':');
            require(member(key), "safetensors.duplicate_name", path, ": offset ", at, ": the name ",
                    json_string(key.substr(0, 80)), " came before");
        });
    }
};

inline DType dtype_named(const std::string& dtype, const std::string& place) {
    for (size_t i = 0; i < std::size(dtypes); ++i)
        if (dtype == dtypes[i].name) return static_cast<DType>(i);
    throw Error("safetensors.dtype", place + " has dtype " + json_string(dtype.substr(0, 80)) +
                                         ", known are F32 F64 F16 BF16 U8 U32 U64 I32 I64 BOOL; convert it first");
}

// Reads {"dtype":"F32","shape":[2,3],"data_offsets":[0,24]}. std::exchange() returns what the field held before, so a
// field that comes twice is refused.
inline StoredTensor read_entry(HeaderReader& reader, const std::string& name) {
    check_name(name, reader.path);
    const std::string place = tensor_place(reader.path, name);
    std::optional<DType> dtype;
    std::optional<Shape> shape, offsets;
    reader.object([&](const std::string& field) {
        if (field == "dtype") return !std::exchange(dtype, dtype_named(reader.string(), place));
        if (field == "shape") return !std::exchange(shape, reader.integers());
        reader.expect(field == "data_offsets", "dtype, shape or data_offsets");
        return !std::exchange(offsets, reader.integers());
    });
    const bool complete = dtype && shape && offsets && offsets->size() == 2;
    reader.expect(complete, "dtype, shape and two data_offsets before this");
    const size_t begin = offsets->front(), end = offsets->back();
    require(begin <= end, "safetensors.offsets", place, ": data_offsets ", begin, ", ", end, " end before they begin");
    require(byte_size(*shape, *dtype) == end - begin, "safetensors.shape", place, ": shape ", shape_text(*shape),
            " of ", about(*dtype).name, " does not fill data_offsets ", begin, ", ", end);
    return {name, *dtype, *shape, begin, end - begin};
}

// Refuses holes, overlaps and a rest. Sorts the tensors by place: a header of another program may have any order.
// available: bytes of data.
inline void check_layout(TensorFile& file, size_t available) {
    // By size too: an empty tensor comes before the one that follows it.
    std::ranges::stable_sort(file.tensors, {}, [](const StoredTensor& t) { return std::pair(t.begin, t.size); });
    size_t next = 0;
    for (const StoredTensor& tensor : file.tensors) {
        const std::string place = tensor_place(file.path, tensor.name);
        require(tensor.begin == next, "safetensors.offsets", place, ": begins at data offset ", tensor.begin,
                ", expected ", next, ": ", tensor.begin < next ? "tensors overlap" : "there is a hole");
        require(tensor.size <= available - next, "safetensors.truncated", place, " at byte ", file.data_start + next,
                ": needs ", tensor.size, " bytes of data, ", available - next, " are left; the file was cut off");
        next += tensor.size;
    }
    require(next == available, "safetensors.trailing", file.path, ": ", available - next,
            " bytes follow the last tensor; the file is damaged");
}

// Checks and removes this program's two metadata entries. Errors: safetensors.checksum.
inline void check_checksums(TensorFile& file) {
    const auto stored = file.metadata.extract("crc32.header"), tensors = file.metadata.extract("crc32.tensors");
    if (!stored && !tensors) return;
    const std::string_view start = std::string_view(file.buffer).substr(0, file.data_start);
    const bool complete = stored && tensors && start.substr(8).starts_with(header_start) &&
                          tensors.mapped().size() == 8 * file.tensors.size();
    require(complete && start.substr(crc_at, 8) == header_checksum(start), "safetensors.checksum", file.path,
            ": the header does not match its checksum; the file is damaged (a program that rewrites it must "
            "drop the metadata entries crc32.header and crc32.tensors)");
    file.has_checksums = true;
    for (size_t i = 0; i < file.tensors.size(); ++i) {
        const std::string found = hex8(crc32(file.bytes(file.tensors[i])));
        const std::string expected = tensors.mapped().substr(8 * i, 8);
        require(found == expected, "safetensors.checksum", tensor_place(file.path, file.tensors[i].name),
                " has CRC-32 ", found, ", expected ", expected, "; the file is damaged, use another copy");
    }
}

// Reads a file of `size` bytes, its header before its data, so that a file of another kind is refused by its first
// bytes. read(buffer, n) makes `buffer` hold the first n bytes; `path` is for messages. Errors: those of read();
// safetensors.truncated, .header_length, .json, .name, .duplicate_name, .dtype, .shape, .offsets, .trailing, .checksum.
TensorFile parse_safetensors(size_t size, const std::string& path, const auto& read) {
    TensorFile file;
    file.path = path;
    size_t length = 0;
    require(size >= 8, "safetensors.truncated", path, ": offset 0: ", size, " bytes are too few for a header length");
    read(file.buffer, 8);
    require(!file.buffer.starts_with("\x89HDF"), "safetensors.header_length", path,
            ": is an HDF5 file, so a data set (see wodtem info), where a safetensors file is expected");
    std::memcpy(&length, file.buffer.data(), 8);
    require(length <= header_limit, "safetensors.header_length", path, ": offset 0: header length ", length,
            " is above ", header_limit, "; not a safetensors file?");
    require(length <= size - 8, "safetensors.truncated", path, ": offset 8: the header should have ", length,
            " bytes, ", size - 8, " follow; the file was cut off");
    file.data_start = 8 + length;
    read(file.buffer, file.data_start);

    HeaderReader reader{std::string_view(file.buffer).substr(0, file.data_start), path};
    reader.expect(is_utf8(reader.file.substr(8)), "a header in UTF-8");
    reader.object([&](const std::string& name) {
        if (name != "__metadata__")
            file.tensors.push_back(read_entry(reader, name));
        else
            reader.object([&](const std::string& key) { return file.metadata.emplace(key, reader.string()).second; });
        return file.index.emplace(name, 0).second;
    });
    reader.skip_space();
    reader.expect(reader.at == file.data_start, "spaces up to the end of the header");

    check_layout(file, size - file.data_start);
    read(file.buffer, size);
    check_checksums(file);
    file.index.erase("__metadata__");
    for (size_t i = 0; i < file.tensors.size(); ++i) file.index[file.tensors[i].name] = i;  // known after the sort
    return file;
}

inline TensorFile parse_safetensors(const std::string& bytes, const std::string& path) {
    return parse_safetensors(bytes.size(), path, [&](std::string& buffer, size_t n) {
        buffer.append(bytes, buffer.size(), n - buffer.size());
    });
}

// Errors: those of parse_safetensors(); file.open, file.not_regular, file.too_large, file.read.
inline TensorFile read_safetensors(const std::string& path) {
    const File file(path, O_RDONLY, "file.open", "open it");
    return parse_safetensors(file.size(), path, [&](std::string& buffer, size_t n) { file.read(buffer, n); });
}

// A file that this program alone writes: its checksums must be there. Errors: safetensors.unchecked beside the above.
inline TensorFile read_own_safetensors(const std::string& path) {
    TensorFile file = read_safetensors(path);
    require(file.has_checksums, "safetensors.unchecked", path,
            ": lacks the metadata entries crc32.header and crc32.tensors, its checksums");
    return file;
}

// ---------------------------------------------------------------------------------------------------------------------
// Archives, for state that lists its fields once: visit(archive) calls archive(name, field) for each of them, or
// archive(name, vector, size) where the program knows how long the vector must be.

struct Saver {
    static constexpr bool loading = false;
    TensorFile& file;
    template <class T>
    void operator()(const std::string& name, const std::vector<T>& values, std::optional<size_t> size = {}) {
        file.add(name, {size.value_or(values.size())}, values);
    }
    void operator()(const std::string& name, const auto& value) { file.add(name, {}, std::array{value}); }
};

// Errors: those of TensorFile::read_into.
struct Loader {
    static constexpr bool loading = true;
    const TensorFile& file;
    // Without `size` a vector that is empty takes the stored size, and another keeps its own.
    template <class T>
    void operator()(const std::string& name, std::vector<T>& values, std::optional<size_t> size = {}) {
        const size_t stored = file.find(name).size / sizeof(T);
        values.resize(size.value_or(values.empty() ? stored : values.size()));
        file.read_into(std::span<T>(values), name, {values.size()});
    }
    void operator()(const std::string& name, auto& value) {
        value = file.get<std::remove_reference_t<decltype(value)>>(name, {})[0];
    }
};
