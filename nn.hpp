// nn.hpp: everything numerical that a decision transformer needs, and nothing about reinforcement learning.
//
// In order: errors; random numbers by counter; worker threads; matrix products: what they are, the kernels for a tile of
// one, how one is shared out; tensors and the tape; the operations of the network, each with its backward; the decision
// transformer (DT, ODT sec. 3); policy heads; optimisers.
// Promises: row-major, last index fastest; float trains, double checks; the same seed gives the same bits for any
// number of threads, on one instruction set (all fused kernels agree, and the portable one with the plain version).
// Leaves out: anything that knows what a return, an episode or a file is.
#pragma once

#include <algorithm>
#include <array>
#include <atomic>
#include <bit>
#include <cmath>
#include <cstdarg>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <functional>
#include <map>
#include <memory>
#include <new>
#include <numeric>
#include <stdexcept>
#include <string>
#include <system_error>
#include <thread>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

#if defined(__x86_64__) && !defined(__clang__)
#define X86_KERNELS  // in AVX2 and AVX-512, beside the portable one
#endif
#define ALWAYS_INLINE [[gnu::always_inline]] inline

// ---------------------------------------------------------------------------------------------------------------------
// Errors. Every failure is one sentence for the person at the terminal (what, where, expected and got, what to do) and
// one stable id ("safetensors.truncated"), by which tests and callers know it.

struct Error : std::runtime_error {
    std::string id;
    Error(std::string error_id, const std::string& sentence) : std::runtime_error(sentence), id(std::move(error_id)) {}
};

// Formats like printf; a sentence of any length.
[[noreturn]] [[gnu::format(printf, 2, 3)]] inline void fail(const char* id, const char* format, ...) {
    va_list arguments, again;
    va_start(arguments, format);
    va_copy(again, arguments);
    std::string sentence(static_cast<size_t>(std::vsnprintf(nullptr, 0, format, arguments)), '\0');
    std::vsnprintf(sentence.data(), sentence.size() + 1, format, again);
    va_end(again);
    va_end(arguments);
    throw Error(id, sentence);
}

// ---------------------------------------------------------------------------------------------------------------------
// Random numbers by counter: a value is a function of (seed, stream, step, site, index) and of nothing else, so no
// order of evaluation, number of threads or interruption can change it, and there is no generator state to save.

using Words4 = std::array<uint32_t, 4>;

// product = m times the low half of x, or of each lane. GCC 12 does not find the one instruction that this takes.
template <class Number>
ALWAYS_INLINE void multiply_low(Number& product, const Number& x, uint32_t m) {
#ifdef X86_KERNELS
    if constexpr (sizeof(Number) == 64) {
        asm("vpmuludq %2, %1, %0" : "=v"(product) : "v"(x), "v"(Number{} + m));
        return;
    }
#endif
    product = (x & 0xFFFFFFFF) * m;
}

// Philox4x32-10. Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011, section 3.3.
// Of one or more counters, in the low halves of 64 bits (what the high ones hold does not matter). They take turns: a
// product is long in coming.
template <class Number, size_t Count>
ALWAYS_INLINE void philox_rounds(Number (&counters)[Count][4], uint32_t key0, uint32_t key1) {
    for (int round = 0; round < 10; ++round) {
        for (Number(&c)[4] : counters) {
            Number product0, product1;
            multiply_low(product0, c[0], 0xD2511F53);
            multiply_low(product1, c[2], 0xCD9E8D57);
            c[0] = (product1 >> 32) ^ c[1] ^ key0;
            c[1] = product1;
            c[2] = (product0 >> 32) ^ c[3] ^ key1;
            c[3] = product0;
        }
        key0 += 0x9E3779B9;  // golden ratio
        key1 += 0xBB67AE85;  // sqrt(3) - 1
    }
}

inline Words4 philox(const Words4& counter, uint32_t key0, uint32_t key1) {
    uint64_t c[1][4] = {{counter[0], counter[1], counter[2], counter[3]}};
    philox_rounds(c, key0, key1);
    Words4 words;
    for (size_t j = 0; j < 4; ++j) words[j] = static_cast<uint32_t>(c[0][j]);
    return words;
}

// For the loops that cost most: compiled once for each instruction set, and chosen when the program starts. Every
// operation is rounded by itself (-ffp-contract=off), so the bits are the same. (The sanitizers cannot start with it.)
#if defined(X86_KERNELS) && !defined(__SANITIZE_ADDRESS__) && !defined(__SANITIZE_THREAD__)
#define EACH_TARGET __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define EACH_TARGET
#endif

// Whether vectors of 64 bytes fit a register. Where they do not, GCC 12 takes them apart in memory, ten times as slow
// as vectors of 32.
#ifdef X86_KERNELS
inline const bool wide_vectors = __builtin_cpu_supports("x86-64-v4");
#else
constexpr bool wide_vectors = false;
#endif

// words[4 i + j] = philox({counter[0] + i, counter[1], counter[2], counter[3]})[j] for i < 16.
inline void philox_16_plain(uint32_t* words, const Words4& counter, uint32_t key0, uint32_t key1) {
    for (uint32_t i = 0; i < 16; ++i) {
        const Words4 four = philox({counter[0] + i, counter[1], counter[2], counter[3]}, key0, key1);
        std::copy(four.begin(), four.end(), words + 4 * i);
    }
}
#ifdef X86_KERNELS
__attribute__((target("arch=x86-64-v4"))) inline void philox_16_avx512(uint32_t* words, const Words4& counter,
                                                                       uint32_t key0, uint32_t key1) {
    typedef uint64_t Lanes __attribute__((vector_size(64)));
    Lanes c[2][4];
    for (uint32_t half = 0; half < 2; ++half) {
        c[half][0] = Lanes{0, 1, 2, 3, 4, 5, 6, 7} + (counter[0] + 8 * half);
        for (size_t j = 1; j < 4; ++j) c[half][j] = Lanes{} + counter[j];
    }
    philox_rounds(c, key0, key1);
    for (size_t i = 0; i < 16; ++i)
        for (size_t j = 0; j < 4; ++j) words[4 * i + j] = static_cast<uint32_t>(c[i / 8][j][i % 8]);
}
inline const auto philox_16 = wide_vectors ? philox_16_avx512 : philox_16_plain;
#else
inline const auto philox_16 = philox_16_plain;
#endif

// Each use of chance has a stream of its own: switching one feature on or off moves no other's numbers. The values are
// part of the format of a run; never renumber. The streams of reinforcement learning are in memory.hpp.
namespace Stream {
constexpr uint32_t initialisation = 1;  // step: tensor number; index: element
constexpr uint32_t dropout = 2;  // step: update; site: place in the network + 2^20 times the part of the batch; index:
                                 // element / 4, counted row by row; attention weights count as
                                 // [query, head, longest sequence of the part]
}  // namespace Stream

struct Random {
    uint32_t seed;
    uint32_t stream;

    // 128 random bits. Counter = (index, site, step low, step high), key = (seed, stream).
    Words4 words(uint64_t step, uint32_t index, uint32_t site = 0) const {
        return philox({index, site, static_cast<uint32_t>(step), static_cast<uint32_t>(step >> 32)}, seed, stream);
    }

    // The words of `index` to `index` + 15, one after the other.
    void words_16(uint32_t* words, uint64_t step, uint32_t index, uint32_t site) const {
        philox_16(words, {index, site, static_cast<uint32_t>(step), static_cast<uint32_t>(step >> 32)}, seed, stream);
    }

    // Uniform in [0, 1), a multiple of 2^-53.
    double uniform(uint64_t step, uint32_t index, uint32_t site = 0) const {
        const Words4 w = words(step, index, site);
        return static_cast<double>(((uint64_t{w[1]} << 32) | w[0]) >> 11) * 0x1p-53;
    }

    // Uniform integer in [0, bound), bound > 0: the high half of a 64 x 64 bit product; bias below bound / 2^64.
    uint64_t below(uint64_t bound, uint64_t step, uint32_t index, uint32_t site = 0) const {
        const Words4 w = words(step, index, site);
        __extension__ using uint128 = unsigned __int128;
        return static_cast<uint64_t>((static_cast<uint128>((uint64_t{w[1]} << 32) | w[0]) * bound) >> 64);
    }

    // Standard normal by Box and Muller, from words 2 and 3. The float functions of libm give the same bits on every
    // x86 processor, the double ones do not; 24 bits reach 5.8 standard deviations.
    float normal(uint64_t step, uint32_t index, uint32_t site = 0) const {
        const Words4 w = words(step, index, site);
        const float u = (static_cast<float>(w[2] >> 8) + 1.0f) * 0x1p-24f;  // (0, 1]
        const float angle = static_cast<float>(w[3] >> 8) * (0x1p-24f * 6.2831853f);
        return std::sqrt(-2.0f * std::log(u)) * std::cos(angle);
    }
};

// ---------------------------------------------------------------------------------------------------------------------
// Threads. A fixed set of workers that share out numbered tasks. Who runs a task is left to chance; what a task
// computes must depend on its number alone, so that results are the same for any number of threads.

class Threads {
  public:
    // `count` >= 1 threads in all, the calling one among them.
    // Errors: nn.threads if the system refuses one.
    explicit Threads(int count) {
        try {
            for (int worker = 1; worker < count; ++worker) workers_.emplace_back([this, worker] { work(worker); });
        } catch (const std::system_error& error) {
            stop();
            fail("nn.threads", "cannot start %d threads: %s; use fewer", count, error.what());
        }
    }
    ~Threads() { stop(); }
    Threads(const Threads&) = delete;
    Threads& operator=(const Threads&) = delete;

    int count() const { return static_cast<int>(workers_.size()) + 1; }

    // Calls f(task, worker) once for each task in [0, tasks) and returns when all are done; 0 <= worker < count().
    // f must not throw and must not call run(). `serial`: the calling thread alone.
    template <class F>
    void run(int tasks, F&& f, bool serial = false) {
        if (serial || workers_.empty() || tasks < 2) {
            for (int task = 0; task < tasks; ++task) f(task, 0);
            return;
        }
        using Body = std::remove_reference_t<F>;
        call_.store([](void* body, int task, int worker) { (*static_cast<Body*>(body))(task, worker); },
                    std::memory_order_relaxed);
        body_.store(const_cast<void*>(static_cast<const void*>(&f)), std::memory_order_relaxed);
        tasks_.store(static_cast<uint32_t>(tasks), std::memory_order_relaxed);
        unfinished_.store(tasks, std::memory_order_relaxed);
        // Ticket = (generation, tasks not yet taken). The release makes the job above visible to whoever sees it.
        const uint64_t generation = (ticket_.load(std::memory_order_relaxed) >> 32) + 1;
        ticket_.store(generation << 32 | static_cast<uint32_t>(tasks), std::memory_order_release);
        ticket_.notify_all();
        take_tasks(0);
        for (int spins = 0; unfinished_.load(std::memory_order_acquire) != 0; ++spins) pause(spins);
    }

  private:
    using Call = void (*)(void*, int, int);

    static void pause(int spins) {
        if (spins > 2000) std::this_thread::yield();
#if defined(__x86_64__)
        __builtin_ia32_pause();
#endif
    }

    // Takes tasks until none is left. That none is left stands in the ticket itself, so an old ticket never leads into
    // the next job: while it names tasks, its job's fields stay, because run() waits for them; a worker that reads
    // later fields beside it finds that the ticket has moved on, the exchange fails, and nothing was taken.
    uint64_t take_tasks(int worker) {
        uint64_t ticket = ticket_.load(std::memory_order_acquire);
        while (true) {
            const Call call = call_.load(std::memory_order_relaxed);
            void* body = body_.load(std::memory_order_relaxed);
            const uint32_t left = static_cast<uint32_t>(ticket), task = tasks_.load(std::memory_order_relaxed) - left;
            if (left == 0) return ticket;
            if (!ticket_.compare_exchange_weak(ticket, ticket - 1, std::memory_order_acq_rel)) continue;
            call(body, static_cast<int>(task), worker);
            unfinished_.fetch_sub(1, std::memory_order_release);
            ticket = ticket_.load(std::memory_order_acquire);
        }
    }

    void stop() {
        stop_.store(true, std::memory_order_relaxed);
        ticket_.fetch_add(uint64_t{1} << 32, std::memory_order_release);
        ticket_.notify_all();
        for (std::thread& worker : workers_) worker.join();
    }

    // Spins for some milliseconds between jobs, soon giving way to whoever else wants the core, then sleeps: to be
    // woken can take longer than a small job, above all on a virtual machine.
    void work(int worker) {
        while (true) {
            const uint64_t seen = take_tasks(worker);
            if (stop_.load(std::memory_order_relaxed)) return;  // `seen` may be the last ticket: none follows it
            for (int spins = 0; spins < 20000 && ticket_.load(std::memory_order_relaxed) == seen; ++spins) pause(spins);
            ticket_.wait(seen, std::memory_order_acquire);
        }
    }

    std::vector<std::thread> workers_;
    std::atomic<uint64_t> ticket_{0};
    std::atomic<Call> call_{nullptr};
    std::atomic<void*> body_{nullptr};
    std::atomic<uint32_t> tasks_{0};
    std::atomic<int> unfinished_{0};
    std::atomic<bool> stop_{false};
};

// ---------------------------------------------------------------------------------------------------------------------
// Matrix products. C [M, N] = or += A [M, K] B [K, N]. Index order everywhere: row-major, last index fastest.

// A matrix inside a larger one: element (i, j) at data[i * stride + j], or at data[j * stride + i] if transposed.
template <class T>
struct View {
    T* data;
    int stride;
    bool transposed = false;
    bool lasting = false;  // as B: used again before it changes (KeepPacked below)
    T& operator()(int i, int j) const {
        return transposed ? data[static_cast<ptrdiff_t>(j) * stride + i] : data[static_cast<ptrdiff_t>(i) * stride + j];
    }
};

// The order of additions is part of the definition: sums of `sum_block` products, each from zero and in order of k, are
// added to C in order. It bounds the error for long K by about (sum_block + K / sum_block) * 2^-24 * sum |a b|, and
// every kernel follows it, so an element does not depend on M, N, tile shapes or threads.
constexpr int sum_block = 256;

enum class Store { overwrite, accumulate };

template <class T>
void matmul_plain(View<T> c, View<const T> a, View<const T> b, int M, int N, int K, Store store) {
    for (int i = 0; i < M; ++i)
        for (int j = 0; j < N; ++j) {
            if (store == Store::overwrite) c(i, j) = 0;
            for (int first = 0; first < K; first += sum_block) {
                T sum = 0;
                for (int k = first; k < std::min(K, first + sum_block); ++k) sum += a(i, k) * b(k, j);
                c(i, j) += sum;
            }
        }
}

// ---------------------------------------------------------------------------------------------------------------------
// Kernels. What computes one tile of a product, for each instruction set.

// One tile of C from packed panels: a [depth, tile rows], b [depth, tile columns], depth <= sum_block. Writes (`add`:
// adds) the upper left rows x columns of the tile to c.
using TileFunction = void (*)(float* c, int c_stride, const void* a, const void* b, int depth, int rows, int columns,
                              bool add);

// Copies `used` lines of `depth` elements into a panel, filling up with zeros; element (k, w) of the panel comes from
// view(k, w) offset by (first_k, first_w). Lines are rows of A or columns of B.
using PackFunction = void (*)(void* panel, View<const float> view, int first_k, int first_w, int depth, int used);

// One way to compute the products of float matrices. The sharing-out below knows a kernel by this record alone: the
// packed panels are opaque to it, so a kernel may store its elements in another format (bf16, say) by its own packing.
struct Kernel {
    const char* name;
    // Kernels of equal arithmetic give the same bits: "fused" rounds once for a multiply-add, "plain" twice, as
    // matmul_plain does.
    const char* arithmetic;
    int tile_rows, tile_columns;
    size_t element_bytes;  // of one element in a panel
    bool (*supported)();   // by this machine
    PackFunction pack_a, pack_b;
    TileFunction tile;
    // Bytes of panels of `lines` lines in all, `depth` elements each.
    size_t panel_bytes(int lines, int depth) const { return element_bytes * lines * depth; }
};

typedef float Float4 __attribute__((vector_size(16)));
typedef float Float8 __attribute__((vector_size(32)));
typedef float Float16 __attribute__((vector_size(64)));

// sum += a * b in each lane. GCC 12 has no portable vector multiply-add, so the fused form is one instruction by name.
template <bool Fused, class Vector>
ALWAYS_INLINE void multiply_add(Vector& sum, const Vector& a, const Vector& b) {
#ifdef X86_KERNELS
    if constexpr (Fused) {
        asm("vfmadd231ps %2, %1, %0" : "+v"(sum) : "v"(a), "v"(b));
        return;
    }
#endif
    sum += a * b;
}

template <class Vector, int Rows, int Vectors, bool Fused>
ALWAYS_INLINE void tile_body(float* c, int c_stride, const float* a, const float* b, int depth, int rows, int columns,
                             bool add) {
    typedef Vector Unaligned __attribute__((aligned(4), may_alias));
    constexpr int lanes = sizeof(Vector) / sizeof(float), tile_columns = lanes * Vectors;
    for (int r = 0; r < rows; ++r)  // C may be far away, and is wanted only at the end
        for (int j = 0; j < columns; j += 16) __builtin_prefetch(c + static_cast<ptrdiff_t>(r) * c_stride + j, 1);
    Vector sum[Rows][Vectors] = {};
    for (int k = 0; k < depth; ++k) {
        Vector row_of_b[Vectors];
#pragma GCC unroll 4
        for (int v = 0; v < Vectors; ++v) {
            row_of_b[v] = reinterpret_cast<const Unaligned*>(b + v * lanes)[0];
            __builtin_prefetch(b + 16 * tile_columns + v * lanes);  // in acting, B comes from memory
        }
#pragma GCC unroll 16
        for (int r = 0; r < Rows; ++r) {
            const Vector element_of_a = a[r] - Vector{};  // a broadcast: x - 0 is x, also for -0
#pragma GCC unroll 4
            for (int v = 0; v < Vectors; ++v) multiply_add<Fused>(sum[r][v], element_of_a, row_of_b[v]);
        }
        a += Rows;
        b += tile_columns;
    }
    if (rows == Rows && columns == tile_columns) {
#pragma GCC unroll 16
        for (int r = 0; r < Rows; ++r)
#pragma GCC unroll 4
            for (int v = 0; v < Vectors; ++v) {
                Unaligned* to = reinterpret_cast<Unaligned*>(c + static_cast<ptrdiff_t>(r) * c_stride + v * lanes);
                *to = add ? *to + sum[r][v] : sum[r][v];
            }
        return;
    }
    float whole[Rows * tile_columns];
    std::memcpy(whole, sum, sizeof whole);
    for (int r = 0; r < rows; ++r)
        for (int j = 0; j < columns; ++j) {
            float& to = c[static_cast<ptrdiff_t>(r) * c_stride + j];
            to = add ? to + whole[r * tile_columns + j] : whole[r * tile_columns + j];
        }
}

// to[j * to_stride + i] = from[i * from_stride + j] for i, j < 4.
ALWAYS_INLINE void turn_4x4(float* to, int to_stride, const float* from, int from_stride) {
    typedef Float4 Unaligned __attribute__((aligned(4), may_alias));
    Float4 row[4];
    for (ptrdiff_t i = 0; i < 4; ++i) row[i] = *reinterpret_cast<const Unaligned*>(from + i * from_stride);
    const Float4 a = __builtin_shufflevector(row[0], row[1], 0, 4, 1, 5),
                 b = __builtin_shufflevector(row[2], row[3], 0, 4, 1, 5),
                 c = __builtin_shufflevector(row[0], row[1], 2, 6, 3, 7),
                 d = __builtin_shufflevector(row[2], row[3], 2, 6, 3, 7);
    const Float4 column[4] = {__builtin_shufflevector(a, b, 0, 1, 4, 5), __builtin_shufflevector(a, b, 2, 3, 6, 7),
                              __builtin_shufflevector(c, d, 0, 1, 4, 5), __builtin_shufflevector(c, d, 2, 3, 6, 7)};
    for (ptrdiff_t j = 0; j < 4; ++j) *reinterpret_cast<Unaligned*>(to + j * to_stride) = column[j];
}

// PackFunction for floats: the panel is [depth, width].
template <int Width>
void pack_floats(void* to, View<const float> view, int first_k, int first_w, int depth, int used) {
    float* const panel = static_cast<float*>(to);
    if (!view.transposed) {  // the lines lie side by side: copy along them
        for (int k = 0; k < depth; ++k) {
            const float* line = &view(first_k + k, first_w);
            for (int w = 0; w < used; ++w) panel[k * Width + w] = line[w];  // a few dozen: no call to memcpy
            for (int w = used; w < Width; ++w) panel[k * Width + w] = 0;
        }
        return;
    }
    for (int w = 0; w < used; w += 4) {  // the lines lie along k: turn blocks of 4 x 4
        const int lines = std::min(4, used - w), whole = lines == 4 ? depth / 4 * 4 : 0;
        for (int k = 0; k < whole; k += 4)
            turn_4x4(panel + k * Width + w, Width, &view(first_k + k, first_w + w), view.stride);
        for (int i = 0; i < lines; ++i) {
            const float* line = &view(first_k, first_w + w + i);
            for (int k = whole; k < depth; ++k) panel[k * Width + w + i] = line[k];
        }
    }
    for (int k = 0; used < Width && k < depth; ++k)
        for (int w = used; w < Width; ++w) panel[k * Width + w] = 0;
}

// A kernel for each instruction set: the same body, another vector, compiled for its own target.
#define KERNEL(NAME, TARGET, VECTOR, ROWS, VECTORS, FUSED, SUPPORTED)                                         \
    TARGET inline void tile_##NAME(float* c, int c_stride, const void* a, const void* b, int depth, int rows, \
                                   int columns, bool add) {                                                   \
        tile_body<VECTOR, ROWS, VECTORS, FUSED>(c, c_stride, static_cast<const float*>(a),                    \
                                                static_cast<const float*>(b), depth, rows, columns, add);     \
    }                                                                                                         \
    inline const Kernel kernel_##NAME = vector_kernel<ROWS, VECTORS * sizeof(VECTOR) / sizeof(float)>(        \
        #NAME, FUSED ? "fused" : "plain", [] { return static_cast<bool>(SUPPORTED); }, tile_##NAME);

template <int Rows, int Columns>
constexpr Kernel vector_kernel(const char* name, const char* arithmetic, bool (*supported)(), TileFunction tile) {
    const PackFunction pack_a = pack_floats<Rows>, pack_b = pack_floats<Columns>;
    return {name, arithmetic, Rows, Columns, sizeof(float), supported, pack_a, pack_b, tile};
}

#ifdef X86_KERNELS
KERNEL(avx512, __attribute__((target("avx512f"))), Float16, 12, 2, true, __builtin_cpu_supports("avx512f"))
KERNEL(avx2, __attribute__((target("avx2,fma"))), Float8, 6, 2, true,
       __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
#endif
KERNEL(portable, , Float4, 4, 2, false, true)

// All kernels of this program, best first. A kernel of reduced precision would stand here as one more record.
inline const Kernel* const kernels[] = {
#ifdef X86_KERNELS
    &kernel_avx512, &kernel_avx2,
#endif
    &kernel_portable};

// The fastest kernel that this machine supports.
inline const Kernel& best_kernel() {
    return **std::find_if(std::begin(kernels), std::end(kernels), [](const Kernel* k) { return k->supported(); });
}

// The kernel of this name, or null if there is none or this machine does not support it.
inline const Kernel* find_kernel(const std::string& name) {
    for (const Kernel* kernel : kernels)
        if (name == kernel->name && kernel->supported()) return kernel;
    return nullptr;
}

// ---------------------------------------------------------------------------------------------------------------------
// Products from tiles: packing and sharing out.

// Scratch memory on cache lines (a vector load that straddles two costs two), grown to what was once asked for. What is
// in it lasts until more is asked for.
struct Buffer {
    struct alignas(64) Line {
        char bytes[64];
    };
    std::vector<Line> lines;
    char* room(size_t bytes) {
        if (lines.size() * sizeof(Line) < bytes) lines.resize((bytes + 63) / 64);
        return reinterpret_cast<char*>(lines.data());
    }
};

// Threads, kernel and scratch memory: what every operation below needs in order to run.
struct Compute {
    static constexpr int block_rows = 192;            // of A, that a task packs: for a core's second cache
    static constexpr size_t stretch_bytes = 4 << 20;  // of B that is packed at a time: for the cache that cores share
    const Kernel& kernel;
    Threads threads;
    Buffer packed_b;              // a stretch of B, in panels of tile_columns
    std::vector<Buffer> scratch;  // one per worker, for a task: a block of A in panels, a head's rows
    Buffer sums;                  // of sums_of_blocks
    struct Kept {
        Buffer packed;
        uint64_t period = 0;
    };
    std::map<std::tuple<const float*, int, bool, int, int>, Kept> kept;  // lasting Bs: data, stride, transposed, K, N
    uint64_t period = 0, periods = 0;  // of time in which a lasting B stays what it is; 0: not now
    Compute(const Kernel& chosen, int thread_count)
        : kernel(chosen),
          threads(thread_count),
          scratch(static_cast<size_t>(thread_count)) {}
};

// For as long as it lives, no matrix that is called lasting may change: each is packed once.
struct KeepPacked {
    Compute& compute;
    explicit KeepPacked(Compute& c) : compute(c) { compute.period = ++compute.periods; }
    ~KeepPacked() { compute.period = 0; }
    KeepPacked(const KeepPacked&) = delete;
    KeepPacked& operator=(const KeepPacked&) = delete;
};

template <class N>
N divide_up(N n, std::type_identity_t<N> by) {
    return (n + by - 1) / by;
}

// Rows and columns of C that a task works on.
struct Block {
    int first_row, end_row, first_column, end_column;
};

// Packs lines [first_line, end_line) of A or B, k in [first_k, first_k + depth), into panels of `width` lines: along
// the lines where these run along memory, else 32 k of all panels at a time, which lie side
// by side.
inline void pack_panels(const Kernel& kernel, PackFunction pack, int width, char* to, View<const float> view,
                        int first_k, int depth, int first_line, int end_line) {
    const int slice = view.transposed ? depth : 32;
    for (int k = 0; k < depth; k += slice) {
        char* panel = to + kernel.panel_bytes(width, k);
        for (int line = first_line; line < end_line; line += width, panel += kernel.panel_bytes(width, depth))
            pack(panel, view, first_k + k, line, std::min(slice, depth - k), std::min(width, end_line - line));
    }
}

// The product of a block of rows with panels of B, for one step of k.
inline void matmul_block(const Kernel& kernel, Buffer& scratch, View<float> c, View<const float> a,
                         const char* packed_b, const Block& block, int first_k, int depth, bool add) {
    char* const packed_a = scratch.room(kernel.panel_bytes(Compute::block_rows, sum_block));
    const View<const float> a_lines = {a.data, a.stride, !a.transposed};  // panels of A run along k
    pack_panels(kernel, kernel.pack_a, kernel.tile_rows, packed_a, a_lines, first_k, depth, block.first_row,
                block.end_row);
    for (int j = block.first_column; j < block.end_column; j += kernel.tile_columns)
        for (int i = block.first_row; i < block.end_row; i += kernel.tile_rows)
            kernel.tile(&c(i, j), c.stride, packed_a + kernel.panel_bytes(i - block.first_row, depth),
                        packed_b + kernel.panel_bytes(j, depth), depth, std::min(kernel.tile_rows, block.end_row - i),
                        std::min(kernel.tile_columns, block.end_column - j), add);
}

struct Nothing {
    void operator()(const Block&) const {}
};

// The fast version of matmul_plain: same definition, panels packed for the kernel's tiles.
// after(block) is called for every part of C after its last addition, while it is in a core's cache.
template <class After = Nothing>
void matmul(Compute& compute, View<float> c, View<const float> a, View<const float> b, int M, int N, int K, Store store,
            After after = {}) {
    if (M == 0 || N == 0) return;
    if (K == 0) {  // an empty sum
        for (int i = 0; store == Store::overwrite && i < M; ++i) std::fill_n(&c(i, 0), N, 0.0f);
        return after(Block{0, M, 0, N});
    }
    const Kernel& kernel = compute.kernel;
    const bool serial = static_cast<double>(M) * N * K < 5e4;  // below that, sharing out costs more than it saves
    // Tasks: blocks of rows; for a wide C and few rows, also of columns. As equal as tiles can be shared out.
    const int tiles = divide_up(M, kernel.tile_rows), panels = divide_up(N, kernel.tile_columns);
    const int fewest = std::max(divide_up(tiles, Compute::block_rows / kernel.tile_rows), 4),
              row_blocks = std::min(tiles, divide_up(fewest, compute.threads.count()) * compute.threads.count());
    const int column_blocks = std::clamp(8 / row_blocks, 1, std::max(1, panels / 4));
    // B in stretches of k, a stretch in steps of the kernel's depth, a step in panels. A lasting B is one stretch.
    const size_t step_bytes = kernel.panel_bytes(panels * kernel.tile_columns, std::min(K, sum_block));
    Compute::Kept* const kept =
        b.lasting && compute.period > 0 ? &compute.kept[{b.data, b.stride, b.transposed, K, N}] : nullptr;
    const int all_steps = divide_up(K, sum_block), fitting = static_cast<int>(Compute::stretch_bytes / step_bytes),
              steps = kept ? all_steps : std::clamp(fitting, 1, all_steps);
    Buffer& buffer = kept ? kept->packed : compute.packed_b;
    char* const packed = buffer.room(step_bytes * static_cast<size_t>(steps));
    const bool packed_before = kept && std::exchange(kept->period, compute.period) == compute.period;
    const auto packed_b = [&](int step) { return packed + static_cast<size_t>(step) * step_bytes; };
    for (int first_k = 0; first_k < K; first_k += steps * sum_block) {
        const int end_k = std::min(K, first_k + steps * sum_block);
        const auto depth_at = [&](int k) { return std::min(sum_block, end_k - k); };
        const int at_once = std::max(1, panels / 8), batches = divide_up(panels, at_once);  // panels that a task packs
        if (!packed_before)
            compute.threads.run(
                divide_up(end_k - first_k, sum_block) * batches,
                [&](int task, int) {
                    const int step = task / batches, k = first_k + step * sum_block,
                              first = task % batches * at_once * kernel.tile_columns;
                    pack_panels(kernel, kernel.pack_b, kernel.tile_columns,
                                packed_b(step) + kernel.panel_bytes(first, depth_at(k)), b, k, depth_at(k), first,
                                std::min(N, first + at_once * kernel.tile_columns));
                },
                serial);
        compute.threads.run(
            row_blocks * column_blocks,
            [&](int task, int worker) {
                const int i = task / column_blocks, j = task % column_blocks;
                const auto row = [&](int n) { return std::min(M, tiles * n / row_blocks * kernel.tile_rows); };
                const auto column = [&](int n) {
                    return std::min(N, panels * n / column_blocks * kernel.tile_columns);
                };
                const Block block = {row(i), row(i + 1), column(j), column(j + 1)};
                for (int k = first_k; k < end_k; k += sum_block)
                    matmul_block(kernel, compute.scratch[static_cast<size_t>(worker)], c, a,
                                 packed_b((k - first_k) / sum_block), block, k, depth_at(k),
                                 k > 0 || store == Store::accumulate);
                if (end_k == K) after(block);
            },
            serial);
    }
}

// In double, for checks alone.
template <class After = Nothing>
void matmul(Compute& compute, View<double> c, View<const double> a, View<const double> b, int M, int N, int K,
            Store store, After after = {}) {
    compute.threads.run(M, [&](int i, int) {
        matmul_plain<double>({&c(i, 0), c.stride}, {&a(i, 0), a.stride, a.transposed}, b, 1, N, K, store);
    });
    after(Block{0, M, 0, N});
}

// y_r = x . row_r for up to four rows [n], `stride` apart. The order of additions: 16 lanes (Width of them a vector),
// folded in a fixed tree, in which the rows share vectors, then what is left over: faster than one chain, and as
// reproducible.
template <int Rows, int Width, class T>
ALWAYS_INLINE void dots(T* y, const T* x, const T* rows, ptrdiff_t stride, ptrdiff_t n) {
    typedef T Lanes __attribute__((vector_size(Width * sizeof(T))));
    typedef T Eight __attribute__((vector_size(8 * sizeof(T))));
    typedef Lanes Unaligned __attribute__((aligned(alignof(T)), may_alias));
    Lanes sum[4][16 / Width] = {};
    Eight eight[4], four[2];
    ptrdiff_t i = 0;
    for (; i + 16 <= n; i += 16)
        for (ptrdiff_t r = 0; r < Rows; ++r)
            for (ptrdiff_t h = 0; h < 16; h += Width)
                sum[r][h / Width] += *reinterpret_cast<const Unaligned*>(x + i + h) *
                                     *reinterpret_cast<const Unaligned*>(rows + r * stride + i + h);
    for (size_t r = 0; r < 4; ++r)
        if constexpr (Width == 16)
            eight[r] = __builtin_shufflevector(sum[r][0], sum[r][0], 0, 1, 2, 3, 4, 5, 6, 7) +
                       __builtin_shufflevector(sum[r][0], sum[r][0], 8, 9, 10, 11, 12, 13, 14, 15);
        else
            eight[r] = sum[r][0] + sum[r][1];
    for (size_t pair = 0; pair < 2; ++pair) {
        const Eight &a = eight[2 * pair], &b = eight[2 * pair + 1];
        four[pair] = __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11) +
                     __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15);
    }
    const Eight two = __builtin_shufflevector(four[0], four[1], 0, 1, 4, 5, 8, 9, 12, 13) +
                      __builtin_shufflevector(four[0], four[1], 2, 3, 6, 7, 10, 11, 14, 15);
    const auto one = __builtin_shufflevector(two, two, 0, 2, 4, 6) + __builtin_shufflevector(two, two, 1, 3, 5, 7);
    for (ptrdiff_t r = 0; r < Rows; ++r) {
        T rest = 0;
        for (ptrdiff_t j = i; j < n; ++j) rest += x[j] * rows[r * stride + j];
        y[r] = one[r] + rest;
    }
}

template <class T>
ALWAYS_INLINE T dot(const T* a, const T* b, int n) {
    T y;
    wide_vectors ? dots<1, 16>(&y, a, b, 0, n) : dots<1, 8>(&y, a, b, 0, n);
    return y;
}

// ---------------------------------------------------------------------------------------------------------------------
// Tensors and the tape. Templated on the scalar: float trains, double serves the checks against finite differences.

// Two-dimensional, row-major. `gradient` is null where no gradient is wanted (inputs, acting).
template <class T>
struct Tensor {
    T* value = nullptr;     // [rows, columns]
    T* gradient = nullptr;  // [rows, columns], accumulated
    int rows = 0, columns = 0;
    bool* empty = nullptr;  // while it says so, nothing has been added to the gradient, and it holds no numbers
    size_t size() const { return static_cast<size_t>(rows) * static_cast<size_t>(columns); }
};

// How to store the next addition to x's gradient: the first overwrites, all of it. To be asked once per addition.
template <class T>
Store next_store(Tensor<T> x) {
    return x.empty && std::exchange(*x.empty, false) ? Store::overwrite : Store::accumulate;
}

// x's gradient, to be added to.
template <class T>
T* gradient_of(Tensor<T> x) {
    if (next_store(x) == Store::overwrite) std::fill_n(x.gradient, x.size(), T(0));
    return x.gradient;
}

// Memory that is handed out in pieces and taken back all at once; after the first batch of a shape nothing is
// allocated.
class Arena {
  public:
    // `bytes` bytes aligned to 64, not initialised, valid until reset().
    void* take(size_t bytes) {
        bytes = (bytes + 63) / 64 * 64;
        while (chunk_ < chunks_.size() && used_ + bytes > chunks_[chunk_].bytes) ++chunk_, used_ = 0;
        if (chunk_ == chunks_.size()) add_chunk(std::max(bytes, size_t{1} << 20));
        used_ += bytes;
        return chunks_[chunk_].lines.get() + (used_ - bytes) / sizeof(Buffer::Line);
    }
    // Joins the chunks into one, or batches of ever new shapes would each leave theirs behind.
    void reset() {
        size_t total = 0;
        for (const Chunk& chunk : chunks_) total += chunk.bytes;
        chunk_ = used_ = 0;
        if (chunks_.size() > 1) {
            chunks_.clear();
            add_chunk(total);
        }
    }

  private:
    struct Chunk {
        std::unique_ptr<Buffer::Line[]> lines;
        size_t bytes;
    };
    void add_chunk(size_t bytes) {  // not initialised, as `new` without parentheses leaves it
        chunks_.push_back({std::unique_ptr<Buffer::Line[]>(new Buffer::Line[bytes / sizeof(Buffer::Line)]), bytes});
    }
    std::vector<Chunk> chunks_;
    size_t chunk_ = 0, used_ = 0;
};

// Records each operation's backward step and replays them in reverse. Gradients add up, so a tensor may be used any
// number of times.
template <class T>
struct Tape {
    Compute& compute;
    bool recording = true;  // false: acting; no gradients, no dropout
    size_t part = 0;        // which part of a batch this tape works on: each has its own dropout masks
    size_t block = 0;       // which of a parameter's gradients this tape adds to
    Random dropout_random{0, Stream::dropout};
    uint64_t dropout_step = 0;  // the update: a fresh mask for each
    // Told of each layer's output as soon as it is there. Empty: no one watches.
    std::function<void(const std::string& name, const Tensor<T>& output)> watch;

    explicit Tape(Compute& c) : compute(c) {}

    // A result; its gradient, if recorded, is empty.
    Tensor<T> make(int rows, int columns) {
        Tensor<T> x = {nullptr, nullptr, rows, columns};
        x.value = scratch<T>(x.size());
        if (recording) {
            x.gradient = scratch<T>(x.size());
            x.empty = scratch<bool>(1);
            *x.empty = true;
        }
        return x;
    }

    // Where this tape adds up the gradient of a parameter.
    T* gradient(Tensor<T> parameter) const { return parameter.gradient + block * parameter.size(); }

    // Shows `output` to whoever watches.
    Tensor<T> show(const std::string& name, Tensor<T> output) const {
        if (watch) watch(name, output);
        return output;
    }

    // An input: copied, without gradient.
    template <class Number>
    Tensor<T> constant(const Number* data, int rows, int columns) {
        Tensor<T> x = {nullptr, nullptr, rows, columns};
        x.value = scratch<T>(x.size());
        std::copy_n(data, x.size(), x.value);
        return x;
    }

    template <class Element>
    Element* scratch(size_t count) {
        return static_cast<Element*>(arena_.take(count * sizeof(Element)));
    }

    // Keeps `step` for backward(), which takes it if anything has been added to the gradient of its result. It is
    // copied into the arena, so it may hold views and numbers only.
    template <class Step>
    void on_backward(Tensor<T> result, Step step) {
        static_assert(std::is_trivially_destructible_v<Step>);
        if (!recording) return;
        steps_.push_back(
            {[](void* s) { (*static_cast<Step*>(s))(); }, new (arena_.take(sizeof(Step))) Step(step), result.empty});
    }

    // d(loss)/d(everything recorded), for a loss [1, 1].
    void backward(Tensor<T> loss) {
        *gradient_of(loss) = 1;
        for (size_t i = steps_.size(); i-- > 0;)
            if (!steps_[i].empty || !*steps_[i].empty) steps_[i].call(steps_[i].step);
    }

    // Forgets all tensors made so far.
    void reset() {
        steps_.clear();
        arena_.reset();
    }

  private:
    struct Step {
        void (*call)(void*);
        void* step;
        const bool* empty;
    };
    Arena arena_;
    std::vector<Step> steps_;
};

// Shares rows [0, rows) out in blocks; f(begin, end, worker) must treat each row alone. `work`: about how many
// operations a row.
template <class F>
void for_rows(Compute& compute, int rows, int work, F&& f) {
    const int block = std::max(1, std::min(divide_up(rows, 8), 1 + 100000 / std::max(1, work)));
    const bool serial = static_cast<double>(rows) * work < 2e4;
    const auto share = [&](int task, int worker) { f(task * block, std::min(rows, (task + 1) * block), worker); };
    compute.threads.run(divide_up(rows, block), share, serial);
}

// to[j] += sum over rows of from[row, j], rows `stride` apart: each column alone, in order of rows.
template <class T>
void add_column_sums(Compute& compute, T* to, const T* from, int rows, int columns, ptrdiff_t stride) {
    for_rows(compute, divide_up(columns, 64), rows * 64, [=](int begin, int end, int) {
        for (int row = 0; row < rows; ++row)
            for (int j = begin * 64; j < std::min(columns, end * 64); ++j) to[j] += from[row * stride + j];
    });
}

// Column sums that a pass over rows makes on its way: f(row, sums) adds a row's share to the sums [columns] of its
// block of rows_a_sum rows. Returns the blocks' sums, one after the other, for add_column_sums; they last until the
// next call.
constexpr int rows_a_sum = 64;
template <class T, class F>
const T* sums_of_blocks(Compute& compute, int rows, int columns, F&& f) {
    const int blocks = divide_up(rows, rows_a_sum);
    const size_t size = static_cast<size_t>(blocks) * static_cast<size_t>(columns);
    T* const sums = reinterpret_cast<T*>(compute.sums.room(size * sizeof(T)));
    for_rows(compute, blocks, 8 * rows_a_sum * columns, [&](int begin, int end, int) {
        std::fill(sums + static_cast<ptrdiff_t>(begin) * columns, sums + static_cast<ptrdiff_t>(end) * columns, T(0));
        for (int row = begin * rows_a_sum; row < std::min(rows, end * rows_a_sum); ++row)
            f(row, sums + static_cast<ptrdiff_t>(row / rows_a_sum) * columns);
    });
    return sums;
}

// ---------------------------------------------------------------------------------------------------------------------
// Operations, in the order in which the network uses them; each backward stands right below its forward.

// PyTorch keeps a Linear's weight as [out, in] and GPT-2's "Conv1D" as [in, out]; so do we, for the sake of
// checkpoints.
enum class Layout { out_in, in_out };

template <class T>
struct Affine {
    Tensor<T> weight;  // [out, in] or [in, out]
    Tensor<T> bias;    // [1, out]
    Layout layout;
};

// What may follow a sum, element by element, while it is still in a core's cache: forward(y, row, begin, end) finishes
// columns [begin, end) of a row y of the result, backward(dy, y, row, columns) turns that row's gradient, in place,
// into the sum's; begin_backward() comes before that.
struct Identity {
    void begin_backward() {}
    template <class T>
    ALWAYS_INLINE void forward(T*, int, int, int) const {}
    template <class T>
    ALWAYS_INLINE void backward(T*, const T*, int, int) const {}
};

// max(y, 0). The slope at 0 is 0, as in PyTorch; NaN stays.
struct Relu {
    void begin_backward() {}
    template <class T>
    ALWAYS_INLINE void forward(T* y, int, int begin, int end) const {
        for (int j = begin; j < end; ++j) y[j] = y[j] < 0 ? T(0) : y[j];
    }
    template <class T>
    ALWAYS_INLINE void backward(T* dy, const T* y, int, int columns) const {
        for (int j = 0; j < columns; ++j) dy[j] = y[j] > 0 ? dy[j] : T(0);
    }
};

// finish(x W + b) of x [n, in], columns [first, first + count) of it: y [n, count].
template <class T, class Finish = Identity>
Tensor<T> linear(Tape<T>& tape, Tensor<T> x, const Affine<T>& affine, int first, int count, Finish finish = {}) {
    const Tensor<T> w = affine.weight, y = tape.make(x.rows, count);
    const T* bias = affine.bias.value + first;
    const bool transposed = affine.layout == Layout::out_in;
    const ptrdiff_t offset = transposed ? static_cast<ptrdiff_t>(first) * w.columns : first;
    Compute& compute = tape.compute;
    const auto row_of = [count](T* data, int row) { return data + static_cast<ptrdiff_t>(row) * count; };
    const auto finish_sums = [=](const Block& block) EACH_TARGET {
        for (int row = block.first_row; row < block.end_row; ++row) {
            T* sums = row_of(y.value, row);
            for (int j = block.first_column; j < block.end_column; ++j) sums[j] += bias[j];
            finish.forward(sums, row, block.first_column, block.end_column);
        }
    };
    matmul(compute, View<T>{y.value, count}, {x.value, x.columns}, {w.value + offset, w.columns, transposed, true},
           x.rows, count, x.columns, Store::overwrite, finish_sums);
    T *dw = tape.gradient(w) + offset, *db = tape.gradient(affine.bias) + first;
    tape.on_backward(y, [=, &compute]() mutable {
        finish.begin_backward();
        const T* sums = sums_of_blocks<T>(compute, y.rows, count, [=](int row, T* sum) EACH_TARGET {
            T* dy = row_of(y.gradient, row);
            finish.backward(dy, row_of(y.value, row), row, count);
            for (int j = 0; j < count; ++j) sum[j] += dy[j];
        });
        add_column_sums(compute, db, sums, divide_up(y.rows, rows_a_sum), count, count);
        const View<const T> dy = {y.gradient, count}, in = {x.value, x.columns};
        if (x.gradient)  // dx += dy W^T
            matmul(compute, View<T>{x.gradient, x.columns}, dy, {w.value + offset, w.columns, !transposed, true},
                   x.rows, x.columns, count, next_store(x));
        const auto [a, b] = transposed ? std::pair(dy, in) : std::pair(in, dy);  // dW^T += dy^T x, or dW += x^T dy
        matmul(compute, View<T>{dw, w.columns}, {a.data, a.stride, true}, b, a.stride, b.stride, x.rows,
               Store::accumulate);
    });
    return y;
}

template <class T, class Finish = Identity>
Tensor<T> linear(Tape<T>& tape, Tensor<T> x, const Affine<T>& affine, Finish finish = {}) {
    return linear(tape, x, affine, 0, affine.bias.columns, finish);
}

// to[to_rows[i]] += from[from_rows[i]] for i < count, row by row, and the gradients back; no list: rows 0, 1, ...
template <class T>
void add_named_rows(Tape<T>& tape, Tensor<T> to, const int* to_rows, Tensor<T> from, const int* from_rows, int count) {
    const ptrdiff_t d = to.columns;
    const auto each = [=](auto&& f) {  // f(row of to, row of from)
        for (ptrdiff_t i = 0; i < count; ++i) f((to_rows ? to_rows[i] : i) * d, (from_rows ? from_rows[i] : i) * d);
    };
    each([=](ptrdiff_t a, ptrdiff_t b) {
        for (ptrdiff_t j = 0; j < d; ++j) to.value[a + j] += from.value[b + j];
    });
    tape.on_backward(to, [=] {
        T* const gradient = gradient_of(from);
        each([=](ptrdiff_t a, ptrdiff_t b) {
            for (ptrdiff_t j = 0; j < d; ++j) gradient[b + j] += to.gradient[a + j];
        });
    });
}

// The named rows of x [n, d]: [count, d].
template <class T>
Tensor<T> select_rows(Tape<T>& tape, Tensor<T> x, const int* rows, int count) {
    const Tensor<T> y = tape.make(count, x.columns);
    std::fill_n(y.value, y.size(), T(0));
    add_named_rows(tape, y, nullptr, x, rows, count);
    return y;
}

template <class T>
struct Norm {
    Tensor<T> weight, bias;  // [1, d]
};

// LayerNorm over the columns of x [n, d]: y = finish((x - mean) / sqrt(variance + 1e-5) * weight + bias), variance with
// 1/d.
template <class T, class Finish = Identity>
Tensor<T> layer_norm(Tape<T>& tape, Tensor<T> x, const Norm<T>& norm, Finish finish = {}) {
    const int d = x.columns;
    const Tensor<T> y = tape.make(x.rows, d), weight = norm.weight, bias = norm.bias;
    T* means = tape.template scratch<T>(static_cast<size_t>(x.rows));   // [n]
    T* scales = tape.template scratch<T>(static_cast<size_t>(x.rows));  // [n] 1 / sqrt(variance + 1e-5)
    T* ones = tape.template scratch<T>(static_cast<size_t>(d));         // [d]
    std::fill_n(ones, d, T(1));
    Compute& compute = tape.compute;
    for_rows(compute, x.rows, 8 * d, [=](int begin, int end, int) EACH_TARGET {
        for (ptrdiff_t row = begin; row < end; ++row) {
            const T* in = x.value + row * d;
            T* out = y.value + row * d;
            const T mean = means[row] = dot(in, ones, d) / T(d);
            for (int j = 0; j < d; ++j) out[j] = in[j] - mean;
            const T scale = scales[row] = T(1) / std::sqrt(dot(out, out, d) / T(d) + T(1e-5));
            for (int j = 0; j < d; ++j) out[j] = out[j] * scale * weight.value[j] + bias.value[j];
            finish.forward(out, static_cast<int>(row), 0, d);
        }
    });
    T *d_weight = tape.gradient(weight), *d_bias = tape.gradient(bias);
    tape.on_backward(y, [=, &compute]() mutable {
        finish.begin_backward();
        const Store store = next_store(x);
        // With n = (x - mean) * scale, g = dy * weight: dx = (g - mean(g) - n * mean(g * n)) * scale.
        const T* sums = sums_of_blocks<T>(compute, x.rows, 4 * d, [=](ptrdiff_t row, T* sum) EACH_TARGET {
            const T *in = x.value + row * d, mean = means[row], scale = scales[row];
            T *dy = y.gradient + row * d, *dx = x.gradient + row * d;
            T *g = sum + 2 * d, *n = sum + 3 * d;  // beside the sums, in the cache
            finish.backward(dy, y.value + row * d, static_cast<int>(row), d);
            for (int j = 0; j < d; ++j) {
                n[j] = (in[j] - mean) * scale;
                g[j] = dy[j] * weight.value[j];
                sum[j] += dy[j] * n[j];
                sum[d + j] += dy[j];
            }
            const T mean_g = dot(g, ones, d) / T(d), mean_gn = dot(g, n, d) / T(d);
            if (store == Store::overwrite) std::fill_n(dx, d, T(0));
            for (int j = 0; j < d; ++j) dx[j] += (g[j] - mean_g - n[j] * mean_gn) * scale;
        });
        add_column_sums(compute, d_weight, sums, divide_up(x.rows, rows_a_sum), d, 4 * d);
        add_column_sums(compute, d_bias, sums + d, divide_up(x.rows, rows_a_sum), d, 4 * d);
    });
    return y;
}

// Inverted dropout's factors for the elements of one place in the network: 0 with probability p, 1 / (1 - p) else. They
// come from the counter (update, place, element), so backward makes them again instead of storing them.
struct Dropout {
    Random random;
    uint64_t step;
    uint32_t site;
    float probability;

    // factor [n] of the elements [first, first + n).
    template <class T>
    EACH_TARGET void fill(T* factor, size_t first, size_t n) const {
        const T keep = T(1) / (T(1) - T(probability));
        const uint32_t threshold = static_cast<uint32_t>(static_cast<double>(probability) * 0x1p32);
        if (probability == 0) return void(std::fill_n(factor, n, T(1)));
        for (size_t i = 0; i < n;) {  // element e has word e % 4 of counter e / 4
            uint32_t words[64];
            random.words_16(words, step, static_cast<uint32_t>((first + i) / 4), site);
            const size_t skip = (first + i) % 4, count = std::min(64 - skip, n - i);
            for (size_t j = 0; j < count; ++j) factor[i + j] = words[skip + j] < threshold ? T(0) : keep;
            i += count;
        }
    }

    // x [n] *= the factors of the elements [first, first + n).
    template <class T>
    ALWAYS_INLINE void apply(T* x, size_t first, size_t n) const {
        T factor[256];
        for (size_t i = 0; probability != 0 && i < n; i += 256) {
            const size_t count = std::min(n - i, size_t{256});
            fill(factor, first + i, count);
            for (size_t j = 0; j < count; ++j) x[i + j] *= factor[j];
        }
    }
};

template <class T>
Dropout dropout_at(const Tape<T>& tape, uint32_t site, float probability) {
    const uint32_t own_site = site + static_cast<uint32_t>(tape.part << 20);
    return {tape.dropout_random, tape.dropout_step, own_site, tape.recording ? probability : 0.0f};
}

// residual + dropout(y), or dropout(y) if the residual is empty.
template <class T>
struct DropoutAdd {
    Dropout dropout;
    Tensor<T> residual;  // [n, d]
    ptrdiff_t d;
    Store store = Store::accumulate;  // of the residual's gradient

    DropoutAdd(Dropout chosen, Tensor<T> added, int columns) : dropout(chosen), residual(added), d(columns) {}
    ALWAYS_INLINE void forward(T* y, int row, int begin, int end) const {
        dropout.apply(y + begin, static_cast<size_t>(row * d + begin), static_cast<size_t>(end - begin));
        for (int j = begin; residual.value && j < end; ++j) y[j] += residual.value[row * d + j];
    }
    void begin_backward() { store = next_store(residual); }
    ALWAYS_INLINE void backward(T* dy, const T*, int row, int columns) const {
        if (store == Store::overwrite) std::fill_n(residual.gradient + row * d, columns, T(0));
        for (int j = 0; residual.value && j < columns; ++j) residual.gradient[row * d + j] += dy[j];
        dropout.apply(dy, static_cast<size_t>(row * d), static_cast<size_t>(columns));
    }
};

// Causal attention, plain, one head: out [n, d] = softmax over keys j <= i of (q_i . k_j / sqrt(d)), times v_j.
// q, k, v [n, d] of one sequence. The specification; `attention` below is held to it.
template <class T>
void attention_plain(T* out, const T* q, const T* k, const T* v, int n, int d) {
    std::vector<T> weight(static_cast<size_t>(n));
    for (int i = 0; i < n; ++i) {
        T total = 0;
        for (int j = 0; j <= i; ++j) {
            T score = 0;
            for (int c = 0; c < d; ++c) score += q[i * d + c] * k[j * d + c];
            weight[static_cast<size_t>(j)] = std::exp(score / std::sqrt(T(d)));
            total += weight[static_cast<size_t>(j)];
        }
        for (int c = 0; c < d; ++c) {
            out[i * d + c] = 0;
            for (int j = 0; j <= i; ++j) out[i * d + c] += weight[static_cast<size_t>(j)] / total * v[j * d + c];
        }
    }
}

// How a packed batch of token sequences lies in memory, and which of its tokens ask.
struct Span {
    int first_token, tokens;   // the sequence's rows of k and v
    int first_query, queries;  // its rows of q
};

// to = or += sum_j weight_j row_j, for Width Vectors columns, held in registers (where there are enough).
template <int Width, int Vectors, class T>
ALWAYS_INLINE void add_rows_of(T* to, const T* weight, ptrdiff_t weight_stride, const T* rows, ptrdiff_t stride, int n,
                               Store store) {
    typedef T Lanes __attribute__((vector_size(Width * sizeof(T))));
    typedef Lanes Unaligned __attribute__((aligned(alignof(T)), may_alias));
    Lanes sum[Vectors] = {};
    for (int v = 0; store == Store::accumulate && v < Vectors; ++v)
        sum[v] = *reinterpret_cast<const Unaligned*>(to + Width * v);
    for (int j = 0; j < n; ++j)
        for (int v = 0; v < Vectors; ++v)
            sum[v] += weight[j * weight_stride] * *reinterpret_cast<const Unaligned*>(rows + j * stride + Width * v);
    for (int v = 0; v < Vectors; ++v) *reinterpret_cast<Unaligned*>(to + Width * v) = sum[v];
}

// What attention does with rows [n, size]: y_j = scale (x . row_j), and the sum above.
template <class T>
EACH_TARGET void dot_rows(T* y, const T* x, const T* rows, int n, int size, T scale) {
    ptrdiff_t j = 0;
    for (; j + 4 <= n; j += 4)
        wide_vectors ? dots<4, 16>(y + j, x, rows + j * size, size, size)
                     : dots<4, 8>(y + j, x, rows + j * size, size, size);
    for (; j < n; ++j) y[j] = dot(x, rows + j * size, size);
    for (j = 0; j < n; ++j) y[j] *= scale;
}

template <class T>
EACH_TARGET void add_rows(T* __restrict to, const T* weight, ptrdiff_t weight_stride, const T* __restrict rows, int n,
                          int size, Store store) {
    int c = 0;
    for (; wide_vectors && c + 128 <= size; c += 128)
        add_rows_of<16, 8>(to + c, weight, weight_stride, rows + c, size, n, store);
    for (; c + 64 <= size; c += 64) add_rows_of<8, 8>(to + c, weight, weight_stride, rows + c, size, n, store);
    for (; c + 16 <= size; c += 16) add_rows_of<8, 2>(to + c, weight, weight_stride, rows + c, size, n, store);
    if (store == Store::overwrite) std::fill(to + c, to + size, T(0));
    for (ptrdiff_t j = 0; j < n; ++j)
        for (int i = c; i < size; ++i) to[i] += weight[j * weight_stride] * rows[j * size + i];
}

// Copies rows [n, size] that lie `stride` apart side by side: the gym network's keys are 6 kB apart, 4 kB in its last
// layer, and a cache holds only eight or twelve lines of the same address modulo 4 kB.
template <class T>
void gather_rows(T* to, const T* rows, ptrdiff_t stride, ptrdiff_t n, ptrdiff_t size) {
    for (ptrdiff_t j = 0; j < n; ++j) std::copy_n(rows + j * stride, size, to + j * size);
}

template <class T>
void softmax(T* x, int n) {
    T largest = x[0], total = 0;
    for (int i = 1; i < n; ++i) largest = std::max(largest, x[i]);
    for (int i = 0; i < n; ++i) total += x[i] = std::exp(x[i] - largest);
    for (int i = 0; i < n; ++i) x[i] /= total;
}

// Causal attention with `heads` heads, dropout on the weights, on packed sequences. Positions ascend within a span.
// q [queries, d] and kv [tokens, 2 d], keys, then values; or both are one tensor [tokens, 3 d]: queries, keys, values.
// Head h has columns h d/heads onwards of each. Every row lies in one span. Query i stands at token position[i] of the
// whole batch and sees its own sequence up to and with itself. Returns [queries, d].
template <class T>
Tensor<T> attention(Tape<T>& tape, Tensor<T> q, Tensor<T> kv, int d, const Span* spans, int span_count,
                    const int* position, int heads, Dropout dropout) {
    const int size = d / heads;
    const ptrdiff_t q_stride = q.columns, stride = kv.columns, keys = stride - 2 * d;
    const T scale = T(1) / std::sqrt(T(size));
    const Tensor<T> out = tape.make(q.rows, d);
    int longest = 1;
    for (int s = 0; s < span_count; ++s) longest = std::max(longest, spans[s].tokens);
    const ptrdiff_t head = longest, query = heads * head;  // from the weights of one to those of the next
    const size_t all = static_cast<size_t>(q.rows * query);
    T* weights = tape.template scratch<T>(all);  // [queries, heads, longest]
    T* d_weights = tape.template scratch<T>(tape.recording ? all : 0);
    Compute& compute = tape.compute;
    const int work = static_cast<int>(std::min(1e9, 4.0 * longest * d * std::max(1, q.rows / std::max(1, span_count))));
    // f(span, head, room for the head's part of `longest` rows, room for `longest` numbers)
    const auto each_head = [=, &compute](int cost, auto&& f) {
        for_rows(compute, span_count, cost, [=, &compute](int begin, int end, int worker) {
            Buffer& scratch = compute.scratch[static_cast<size_t>(worker)];
            T* const room = reinterpret_cast<T*>(scratch.room(static_cast<size_t>(longest * (size + 1)) * sizeof(T)));
            for (int s = begin; s < end; ++s)
                for (int h = 0; h < heads; ++h) f(spans[s], h, room, room + longest * size);
        });
    };
    const auto seen_by = [=](ptrdiff_t i, const Span& span) { return position[i] - span.first_token + 1; };
    each_head(work, [=](const Span& span, int h, T* rows, T* factor) {
        const ptrdiff_t end = span.first_query + span.queries;
        const T* const key = kv.value + span.first_token * stride + keys + h * size;
        gather_rows(rows, key, stride, span.tokens, size);
        for (ptrdiff_t i = span.first_query; i < end; ++i) {
            T* const w = weights + i * query + h * head;
            dot_rows(w, q.value + i * q_stride + h * size, rows, seen_by(i, span), size, scale);
            softmax(w, seen_by(i, span));
        }
        gather_rows(rows, key + d, stride, span.tokens, size);  // values
        for (ptrdiff_t i = span.first_query; i < end; ++i) {
            const int seen = seen_by(i, span);
            const T* const w = weights + i * query + h * head;
            dropout.fill(factor, static_cast<size_t>(w - weights), static_cast<size_t>(seen));
            for (int j = 0; j < seen; ++j) factor[j] *= w[j];
            add_rows(out.value + i * d + h * size, factor, 1, rows, seen, size, Store::overwrite);
        }
    });
    tape.on_backward(out, [=] {
        const Store to_q = next_store(q), to_kv = q.value == kv.value ? to_q : next_store(kv);
        each_head(2 * work, [=](const Span& span, int h, T* rows, T* factor) {
            const ptrdiff_t first = span.first_query, end = first + span.queries, at = h * size;
            const ptrdiff_t first_key = span.first_token * stride + keys + at;
            gather_rows(rows, kv.value + first_key + d, stride, span.tokens, size);  // values
            for (ptrdiff_t i = first; i < end; ++i) {
                const int seen = seen_by(i, span);
                T *w = weights + i * query + h * head, *dw = d_weights + i * query + h * head;
                // dw_j = factor_j v_j . d_out; through the softmax, d_score_j = w_j (dw_j - sum_m w_m dw_m).
                dot_rows(dw, out.gradient + i * d + at, rows, seen, size, T(1));
                dropout.fill(factor, static_cast<size_t>(w - weights), static_cast<size_t>(seen));
                for (int j = 0; j < seen; ++j) dw[j] *= factor[j];
                const T mean = dot(w, dw, seen);
                for (int j = 0; j < seen; ++j) dw[j] = w[j] * (dw[j] - mean) * scale, w[j] *= factor[j];
            }
            // d_q_i = sum over the keys j that i sees of d_score_ij k_j.
            gather_rows(rows, kv.value + first_key, stride, span.tokens, size);
            for (ptrdiff_t i = first; i < end; ++i)
                add_rows(q.gradient + i * q_stride + at, d_weights + i * query + h * head, 1, rows, seen_by(i, span),
                         size, to_q);
            // d_k_j = sum over the queries i that see j of d_score_ij q_i; d_v_j = sum of factor_ij w_ij d_out_i.
            const auto each_key = [=](T* d_key, const T* weight, const T* asking, ptrdiff_t from_one_to_next) {
                gather_rows(rows, asking + first * from_one_to_next + at, from_one_to_next, span.queries, size);
                for (ptrdiff_t j = 0, i = first; j < span.tokens; ++j, d_key += stride) {
                    while (i < end && seen_by(i, span) <= j) ++i;
                    add_rows(d_key, weight + i * query + h * head + j, query, rows + (i - first) * size,
                             static_cast<int>(end - i), size, to_kv);
                }
            };
            each_key(kv.gradient + first_key, d_weights, q.value, q_stride);
            each_key(kv.gradient + first_key + d, weights, out.gradient, d);
        });
    });
    return out;
}

// ---------------------------------------------------------------------------------------------------------------------
// Parameters by name, and how each kind starts.

enum class Init {
    zeros,
    ones,
    normal_002,      // N(0, 0.02^2): weights inside the GPT-2 stack
    normal_1,        // N(0, 1): position table
    uniform_fan_in,  // uniform in +-1/sqrt(fan in): PyTorch's default for a Linear's weight and bias
    orthogonal,      // orthonormal rows: the policy's output layers
};

template <class T>
struct Parameter {
    std::string name;             // ODT's name in its state_dict
    std::vector<uint64_t> shape;  // as saved
    std::vector<T> value;
    std::vector<T> gradient;  // [blocks, size]: one for each part of a batch that is worked on by itself
    Tensor<T> tensor() { return {value.data(), gradient.data(), rows(), static_cast<int>(shape.back())}; }
    int rows() const { return shape.size() == 1 ? 1 : static_cast<int>(shape[0]); }
};

// Makes rows [rows, columns], rows <= columns, of independent normals orthonormal (Gram-Schmidt): a random rotation.
inline void orthonormalise(std::vector<double>& x, int rows, int columns) {
    for (int i = 0; i < rows; ++i) {
        double* row = x.data() + static_cast<ptrdiff_t>(i) * columns;
        for (int j = 0; j < i; ++j) {
            const double* other = x.data() + static_cast<ptrdiff_t>(j) * columns;
            const double along = dot(row, other, columns);
            for (int c = 0; c < columns; ++c) row[c] -= along * other[c];
        }
        const double norm = std::sqrt(dot(row, row, columns));
        for (int c = 0; c < columns; ++c) row[c] /= norm;
    }
}

// Start values from Stream::initialisation (step: number of the tensor, index: element).
template <class T>
void initialise(Parameter<T>& parameter, Init init, int fan_in, uint32_t seed, uint64_t number) {
    const Random random = {seed, Stream::initialisation};
    const size_t n = parameter.value.size();
    std::vector<double> x(n);
    for (uint32_t i = 0; i < n; ++i) {
        if (init == Init::ones) x[i] = 1;
        if (init == Init::normal_002) x[i] = 0.02 * random.normal(number, i);
        if (init == Init::normal_1 || init == Init::orthogonal) x[i] = random.normal(number, i);
        if (init == Init::uniform_fan_in) x[i] = (2 * random.uniform(number, i) - 1) / std::sqrt(fan_in);
    }
    if (init == Init::orthogonal) orthonormalise(x, parameter.rows(), static_cast<int>(parameter.shape.back()));
    for (size_t i = 0; i < n; ++i) parameter.value[i] = static_cast<T>(x[i]);
}

// ---------------------------------------------------------------------------------------------------------------------
// The decision transformer: GPT-2 blocks over the tokens R_1 s_1 a_1 R_2 s_2 a_2 ... of each window.
// DT sec. 3, ODT sec. 3. Sequences are packed, never padded, and only what the action prediction needs is computed: the
// last action of a window is never a token, and in the last layer only the asking state tokens go on after attention.

enum class Head { squashed_gaussian, categorical, deterministic };

struct TransformerConfig {
    int state_dim, action_dim;  // widths of the state and action tokens' inputs; action_dim is also the heads' width
    int layers, heads, width;
    int max_timesteps;  // rows of the table of absolute positions; 0: no positions (ODT's "ordering" 0)
    float dropout;
    Head head;
};

// Windows of a batch, one after the other. n steps in all.
struct SequenceBatch {
    std::vector<int> lengths;          // [windows] steps of each, >= 1
    std::vector<float> returns_to_go;  // [n] scaled
    std::vector<float> states;         // [n, state_dim] normalised
    std::vector<float> actions;        // [n, action_dim]; those of each window's last step are not read
    std::vector<int> timesteps;        // [n]
    int steps() const { return static_cast<int>(returns_to_go.size()); }
};

enum class Ask { every_state, last_state };  // training learns from every step of a window; acting wants the last

template <class T>
struct Policy {
    Tensor<T> mean;     // [asked, action_dim]; categorical: log-probabilities; deterministic: the action itself
    Tensor<T> log_std;  // [asked, action_dim] in [-5, 2]; squashed Gaussian only
};

template <class T>
struct Transformer {
    struct Block {
        Norm<T> ln_1;
        Affine<T> c_attn, attn_proj;  // c_attn: columns q, k, v in this order
        Norm<T> ln_2;
        Affine<T> c_fc, mlp_proj;
    };
    TransformerConfig config;
    size_t gradient_blocks;
    std::vector<Parameter<T>> parameters;  // in the order of construction
    Affine<T> embed_return, embed_state, embed_action;
    Tensor<T> embed_ordering;  // [max_timesteps, width]
    Norm<T> embed_ln;
    std::vector<Block> blocks;
    Norm<T> ln_f;
    Affine<T> predict_mean, predict_log_std;

    Transformer(const TransformerConfig& c, uint32_t seed, size_t batch_parts = 1)
        : config(c),
          gradient_blocks(batch_parts) {
        const int d = c.width;
        if (c.layers < 1 || c.heads < 1 || d < 1 || d % c.heads != 0)
            fail("nn.config",
                 "a transformer of width %d cannot have %d heads in %d layers: the width must be a multiple of the "
                 "heads, and there must be at least one of each",
                 d, c.heads, c.layers);
        if (c.state_dim < 1 || c.action_dim < 1 || c.max_timesteps < 0 || !(c.dropout >= 0 && c.dropout < 1) ||
            (c.head != Head::deterministic && c.action_dim > d))
            fail(
                "nn.config",
                "a transformer cannot have %d state and %d action dimensions, %d positions and dropout %g: it needs at "
                "least one of each dimension, no more action dimensions than its width, %d, and dropout in [0, 1)",
                c.state_dim, c.action_dim, c.max_timesteps, static_cast<double>(c.dropout), d);
        embed_return = linear_layer("embed_return", 1, d, Init::uniform_fan_in, seed);
        embed_state = linear_layer("embed_state", c.state_dim, d, Init::uniform_fan_in, seed);
        embed_action = linear_layer("embed_action", c.action_dim, d, Init::uniform_fan_in, seed);
        embed_ln = norm("embed_ln", seed);
        for (int layer = 0; layer < c.layers; ++layer) {
            const std::string h = "transformer.h." + std::to_string(layer) + ".";
            Block block;
            block.ln_1 = norm(h + "ln_1", seed);
            block.c_attn = conv1d(h + "attn.c_attn", d, 3 * d, seed);
            block.attn_proj = conv1d(h + "attn.c_proj", d, d, seed);
            block.ln_2 = norm(h + "ln_2", seed);
            block.c_fc = conv1d(h + "mlp.c_fc", d, 4 * d, seed);
            block.mlp_proj = conv1d(h + "mlp.c_proj", 4 * d, d, seed);
            blocks.push_back(block);
        }
        ln_f = norm("transformer.ln_f", seed);
        if (c.head == Head::squashed_gaussian) {
            predict_mean = linear_layer("predict_action.mu", d, c.action_dim, Init::orthogonal, seed);
            predict_log_std = linear_layer("predict_action.log_std", d, c.action_dim, Init::orthogonal, seed);
        } else if (c.head == Head::categorical) {
            predict_mean = linear_layer("predict_action.logits", d, c.action_dim, Init::orthogonal, seed);
        } else {
            predict_mean = linear_layer("predict_action.0", d, c.action_dim, Init::uniform_fan_in, seed);
        }
        // Last, so that having it moves no other tensor's random numbers.
        if (c.max_timesteps > 0)
            embed_ordering = add("embed_ordering.weight", {c.max_timesteps, d}, Init::normal_1, 0, seed);
    }
    Transformer(const Transformer&) = delete;
    Transformer& operator=(const Transformer&) = delete;

  private:
    Tensor<T> add(const std::string& name, const std::vector<int>& shape, Init init, int fan_in, uint32_t seed) {
        Parameter<T> parameter;
        parameter.name = name;
        parameter.shape.assign(shape.begin(), shape.end());
        size_t size = 1;
        for (int extent : shape) size *= static_cast<size_t>(extent);
        parameter.value.resize(size);
        parameter.gradient.resize(size * gradient_blocks);
        initialise(parameter, init, fan_in, seed, parameters.size());
        parameters.push_back(std::move(parameter));  // moving a vector keeps its memory: tensors stay valid
        return parameters.back().tensor();
    }
    Affine<T> linear_layer(const std::string& name, int in, int out, Init init, uint32_t seed) {
        const Tensor<T> weight = add(name + ".weight", {out, in}, init, in, seed);
        const Init bias = init == Init::orthogonal ? Init::zeros : init;
        return {weight, add(name + ".bias", {out}, bias, in, seed), Layout::out_in};
    }
    Affine<T> conv1d(const std::string& name, int in, int out, uint32_t seed) {
        const Tensor<T> weight = add(name + ".weight", {in, out}, Init::normal_002, in, seed);
        return {weight, add(name + ".bias", {out}, Init::zeros, in, seed), Layout::in_out};
    }
    Norm<T> norm(const std::string& name, uint32_t seed) {
        const Tensor<T> weight = add(name + ".weight", {config.width}, Init::ones, 0, seed);
        return {weight, add(name + ".bias", {config.width}, Init::zeros, 0, seed)};
    }
};

// Where each token of a packed batch lies.
struct TokenLayout {
    int tokens = 0;
    std::vector<Span> all, asked;          // a span per window; queries: all its tokens, or the asking ones
    std::vector<int> every_token, asking;  // token rows that ask, in all layers but the last, and in the last
    std::vector<int> step_token;           // [n] row of a step's R token; s and a follow
};

inline TokenLayout token_layout(const SequenceBatch& batch, Ask ask) {
    TokenLayout layout;
    for (const int length : batch.lengths) {
        const int tokens = 3 * length - 1, first_asking = static_cast<int>(layout.asking.size());
        for (int c = 0; c < length; ++c) {
            layout.step_token.push_back(layout.tokens + 3 * c);
            if (ask == Ask::every_state || c == length - 1) layout.asking.push_back(layout.tokens + 3 * c + 1);
        }
        layout.all.push_back({layout.tokens, tokens, layout.tokens, tokens});
        layout.asked.push_back(
            {layout.tokens, tokens, first_asking, static_cast<int>(layout.asking.size()) - first_asking});
        for (int i = 0; i < tokens; ++i) layout.every_token.push_back(layout.tokens + i);
        layout.tokens += tokens;
    }
    return layout;
}

// An array that the tape keeps until it is reset, as its steps need it.
template <class T, class Element>
const Element* keep(Tape<T>& tape, const std::vector<Element>& x) {
    return static_cast<const Element*>(
        std::memcpy(tape.template scratch<Element>(x.size() + 1), x.data(), x.size() * sizeof(Element)));
}

// The tokens R, s, a of every step, each through its own linear layer, plus the position's row: [tokens, width].
template <class T>
Tensor<T> embed_tokens(Tape<T>& tape, const Transformer<T>& model, const SequenceBatch& batch,
                       const TokenLayout& layout) {
    const TransformerConfig& config = model.config;
    const int A = config.action_dim;
    const Tensor<T> tokens = tape.make(layout.tokens, config.width);
    std::fill_n(tokens.value, tokens.size(), T(0));
    Tensor<T> positions = model.embed_ordering;
    positions.gradient = tape.gradient(positions);
    // The tokens of the named steps, `offset` after their R: inputs of each through the layer, plus the position's row.
    const auto place = [&](const std::vector<size_t>& steps, int offset, const auto& inputs, int columns,
                           const Affine<T>& layer) {
        const int count = static_cast<int>(steps.size());
        if (count == 0) return;
        std::vector<int> rows, timesteps;
        for (const size_t step : steps) {
            rows.push_back(layout.step_token[step] + offset);
            if (config.max_timesteps > 0)  // ODT clips at the end of its table
                timesteps.push_back(std::min(batch.timesteps[step], config.max_timesteps - 1));
        }
        const int* kept = keep(tape, rows);
        const Tensor<T> embedded = linear(tape, tape.constant(inputs.data(), count, columns), layer);
        add_named_rows(tape, tokens, kept, embedded, nullptr, count);
        if (!timesteps.empty()) add_named_rows(tape, tokens, kept, positions, keep(tape, timesteps), count);
    };
    std::vector<size_t> all(batch.returns_to_go.size()), acted;  // steps: all, and those whose action is a token
    std::iota(all.begin(), all.end(), size_t{0});
    std::vector<float> actions;
    for (size_t window = 0, step = 0; window < batch.lengths.size(); ++window, ++step)
        for (int c = 0; c + 1 < batch.lengths[window]; ++c, ++step) {
            acted.push_back(step);
            const auto first = batch.actions.begin() + static_cast<ptrdiff_t>(step) * A;
            actions.insert(actions.end(), first, first + A);
        }
    place(all, 0, batch.returns_to_go, 1, model.embed_return);
    place(all, 1, batch.states, config.state_dim, model.embed_state);
    place(acted, 2, actions, A, model.embed_action);
    return tokens;
}

// Dropout's places: 0 after the embedding's LayerNorm, then three a layer.
inline uint32_t dropout_site(int layer, int place) { return static_cast<uint32_t>(1 + 3 * layer + place); }

// One pre-LN block: x + attention(LN(x)), then + MLP(LN(.)). x [tokens, d] -> [spans' queries, d] for the rows that
// ask.
template <class T>
Tensor<T> transformer_block(Tape<T>& tape, const Transformer<T>& model, int layer, Tensor<T> x,
                            const std::vector<Span>& spans, const std::vector<int>& asking) {
    const typename Transformer<T>::Block& block = model.blocks[static_cast<size_t>(layer)];
    const int d = model.config.width, asked = static_cast<int>(asking.size());
    const float p = model.config.dropout;
    const bool all_ask = asked == x.rows;
    const int* rows = keep(tape, asking);
    const Tensor<T> h = layer_norm(tape, x, block.ln_1);
    const Tensor<T> q = all_ask ? linear(tape, h, block.c_attn)  // keys and values as well
                                : linear(tape, select_rows(tape, h, rows, asked), block.c_attn, 0, d);
    const Tensor<T> kv = all_ask ? q : linear(tape, h, block.c_attn, d, 2 * d);
    const Tensor<T> a = attention(tape, q, kv, d, keep(tape, spans), static_cast<int>(spans.size()), rows,
                                  model.config.heads, dropout_at(tape, dropout_site(layer, 0), p));
    const DropoutAdd<T> add_x(dropout_at(tape, dropout_site(layer, 1), p),
                              all_ask ? x : select_rows(tape, x, rows, asked), d);
    const std::string name = "transformer.h." + std::to_string(layer);
    const Tensor<T> x1 = tape.show(name + ".attn", linear(tape, a, block.attn_proj, add_x));
    const Tensor<T> hidden = linear(tape, layer_norm(tape, x1, block.ln_2), block.c_fc, Relu{});
    const DropoutAdd<T> add_x1(dropout_at(tape, dropout_site(layer, 2), p), x1, d);
    return tape.show(name, linear(tape, hidden, block.mlp_proj, add_x1));
}

// f(x) of each element; slope(x, y) is the derivative there.
template <class T, class F, class Slope>
Tensor<T> map(Tape<T>& tape, Tensor<T> x, F f, Slope slope) {
    const Tensor<T> y = tape.make(x.rows, x.columns);
    for (size_t i = 0; i < x.size(); ++i) y.value[i] = f(x.value[i]);
    tape.on_backward(y, [=] {
        T* const dx = gradient_of(x);
        for (size_t i = 0; i < x.size(); ++i) dx[i] += slope(x.value[i], y.value[i]) * y.gradient[i];
    });
    return y;
}

// -5 + 3.5 (tanh(x) + 1): the log standard deviation, squashed into [-5, 2]. ODT's code.
template <class T>
Tensor<T> squash_log_std(Tape<T>& tape, Tensor<T> x) {
    const auto value = [](T u) { return T(-5) + T(3.5) * (std::tanh(u) + T(1)); };
    return map(tape, x, value, [](T u, T) {
        const T t = std::tanh(u);
        return T(3.5) * (T(1) - t * t);
    });
}

template <class T>
Tensor<T> tanh_of(Tape<T>& tape, Tensor<T> x) {
    return map(
        tape, x, [](T u) { return std::tanh(u); }, [](T, T y) { return T(1) - y * y; });
}

// log of the softmax of each row of the logits, [n, moves].
template <class T>
Tensor<T> log_softmax(Tape<T>& tape, Tensor<T> logits) {
    const Tensor<T> y = tape.make(logits.rows, logits.columns);
    const ptrdiff_t moves = logits.columns;
    for (ptrdiff_t row = 0; row < logits.rows; ++row) {
        const T* x = logits.value + row * moves;
        const T largest = *std::max_element(x, x + moves);
        T total = 0;
        for (ptrdiff_t j = 0; j < moves; ++j) total += std::exp(x[j] - largest);
        for (ptrdiff_t j = 0; j < moves; ++j) y.value[row * moves + j] = x[j] - largest - std::log(total);
    }
    tape.on_backward(y, [=] {
        T* const dx = gradient_of(logits);
        for (ptrdiff_t row = 0; row < logits.rows; ++row) {
            const T *dy = y.gradient + row * moves, *log_p = y.value + row * moves;
            T total = 0;
            for (ptrdiff_t j = 0; j < moves; ++j) total += dy[j];
            for (ptrdiff_t j = 0; j < moves; ++j) dx[row * moves + j] += dy[j] - std::exp(log_p[j]) * total;
        }
    });
    return y;
}

// pi_theta(. | s_{-C,t}, g_{-C,t}) for every asking state token of the batch, in order of windows and steps.
template <class T>
Policy<T> forward(Tape<T>& tape, const Transformer<T>& model, const SequenceBatch& batch, Ask ask) {
    const TokenLayout layout = token_layout(batch, ask);
    Tensor<T> x = tape.show("embed", embed_tokens(tape, model, batch, layout));
    const DropoutAdd<T> dropout(dropout_at(tape, 0, model.config.dropout), {}, model.config.width);
    x = tape.show("embed_ln", layer_norm(tape, x, model.embed_ln, dropout));
    for (int layer = 0; layer < model.config.layers; ++layer) {
        const bool last = layer + 1 == model.config.layers;
        x = transformer_block(tape, model, layer, x, last ? layout.asked : layout.all,
                              last ? layout.asking : layout.every_token);
    }
    x = tape.show("transformer.ln_f", layer_norm(tape, x, model.ln_f));
    Policy<T> policy = {linear(tape, x, model.predict_mean), {}};
    if (model.config.head == Head::categorical) policy.mean = log_softmax(tape, policy.mean);
    if (model.config.head == Head::deterministic) policy.mean = tanh_of(tape, policy.mean);
    tape.show("policy.mean", policy.mean);
    if (model.config.head == Head::squashed_gaussian)
        policy.log_std = tape.show("policy.log_std", squash_log_std(tape, linear(tape, x, model.predict_log_std)));
    return policy;
}

// ---------------------------------------------------------------------------------------------------------------------
// Policy heads: log-likelihood and entropy of each row, [n, 1].

// log(1 + exp(x)) without overflow.
template <class T>
T softplus(T x) {
    return std::max(x, T(0)) + std::log1p(std::exp(-std::abs(x)));
}

// log |d tanh(u) / du| = log(1 - tanh(u)^2), exact also where tanh rounds to 1.
template <class T>
T log_tanh_slope(T u) {
    return T(2) * (T(0.69314718055994531) - u - softplus(T(-2) * u));
}

constexpr double half_log_2_pi = 0.91893853320467274;

// The sum of each row of [rows, columns] elements, [rows, 1], in order: of value(i) for element i; slope(i, dy) passes
// the gradient of its row's sum on, adding to those of `inputs`.
template <class T, class Value, class Slope>
Tensor<T> row_sums(Tape<T>& tape, std::array<Tensor<T>, 2> inputs, int rows, int columns, Value value, Slope slope) {
    const Tensor<T> y = tape.make(rows, 1);
    std::fill_n(y.value, rows, T(0));
    const ptrdiff_t n = static_cast<ptrdiff_t>(rows) * columns;
    for (ptrdiff_t i = 0; i < n; ++i) y.value[i / columns] += value(i);
    tape.on_backward(y, [=] {
        for (const Tensor<T>& input : inputs) gradient_of(input);
        for (ptrdiff_t i = 0; i < n; ++i) slope(i, y.gradient[i / columns]);
    });
    return y;
}

// log pi(a) of a = tanh(u), u ~ N(mean, exp(log_std)^2), summed over the action's dimensions: with u = atanh(a),
// sum of -((u - mean) / std)^2 / 2 - log_std - log(2 pi) / 2 - log(1 - a^2). actions [n, A], strictly inside (-1, 1).
template <class T>
Tensor<T> gaussian_log_prob(Tape<T>& tape, Policy<T> policy, const float* actions) {
    const Tensor<T> mean = policy.mean, log_std = policy.log_std;
    const Tensor<T> a = tape.constant(actions, mean.rows, mean.columns);
    const auto standardised = [=](ptrdiff_t i) {
        return (std::atanh(a.value[i]) - mean.value[i]) / std::exp(log_std.value[i]);
    };
    const auto value = [=](ptrdiff_t i) {
        const T z = standardised(i);
        return T(-0.5) * z * z - log_std.value[i] - T(half_log_2_pi) - log_tanh_slope(std::atanh(a.value[i]));
    };
    return row_sums(tape, {mean, log_std}, a.rows, a.columns, value, [=](ptrdiff_t i, T dy) {
        const T z = standardised(i);
        mean.gradient[i] += dy * z / std::exp(log_std.value[i]);
        log_std.gradient[i] += dy * (z * z - T(1));
    });
}

// One-sample estimate of the entropy, -log pi(tanh(u)) with u = mean + exp(log_std) noise; noise [n, A] standard
// normal. The gradient flows through the sample, as ODT's does: the Gaussian term is then noise^2 / 2, a constant.
template <class T>
Tensor<T> gaussian_entropy(Tape<T>& tape, Policy<T> policy, const float* noise) {
    const Tensor<T> mean = policy.mean, log_std = policy.log_std;
    const Tensor<T> n = tape.constant(noise, mean.rows, mean.columns);
    const auto sample = [=](ptrdiff_t i) { return mean.value[i] + std::exp(log_std.value[i]) * n.value[i]; };
    const auto value = [=](ptrdiff_t i) {
        return T(0.5) * n.value[i] * n.value[i] + log_std.value[i] + T(half_log_2_pi) + log_tanh_slope(sample(i));
    };
    return row_sums(tape, {mean, log_std}, n.rows, n.columns, value, [=](ptrdiff_t i, T dy) {
        const T slope = T(-2) * std::tanh(sample(i));  // of log_tanh_slope
        mean.gradient[i] += dy * slope;
        log_std.gradient[i] += dy * (T(1) + slope * std::exp(log_std.value[i]) * n.value[i]);
    });
}

// log pi(a): the entry of each row that the action names. actions [n, 1], whole numbers.
template <class T>
Tensor<T> categorical_log_prob(Tape<T>& tape, Tensor<T> log_p, const float* actions) {
    const Tensor<T> a = tape.constant(actions, log_p.rows, 1);
    const auto named = [=](ptrdiff_t row) { return row * log_p.columns + static_cast<ptrdiff_t>(a.value[row]); };
    return row_sums(
        tape, {log_p}, a.rows, 1, [=](ptrdiff_t row) { return log_p.value[named(row)]; },
        [=](ptrdiff_t row, T dy) { log_p.gradient[named(row)] += dy; });
}

// H = -sum p log p, exact.
template <class T>
Tensor<T> categorical_entropy(Tape<T>& tape, Tensor<T> log_p) {
    return row_sums(
        tape, {log_p}, log_p.rows, log_p.columns,
        [=](ptrdiff_t i) { return -std::exp(log_p.value[i]) * log_p.value[i]; },
        [=](ptrdiff_t i, T dy) { log_p.gradient[i] -= dy * std::exp(log_p.value[i]) * (log_p.value[i] + T(1)); });
}

// DT's loss for continuous actions: the squared error of each row, averaged over the action's dimensions.
template <class T>
Tensor<T> squared_error(Tape<T>& tape, Tensor<T> prediction, const float* actions) {
    const Tensor<T> a = tape.constant(actions, prediction.rows, prediction.columns);
    const auto error = [=](ptrdiff_t i) { return prediction.value[i] - a.value[i]; };
    return row_sums(
        tape, {prediction}, a.rows, a.columns, [=](ptrdiff_t i) { return error(i) * error(i) / T(a.columns); },
        [=](ptrdiff_t i, T dy) { prediction.gradient[i] += dy * T(2) * error(i) / T(a.columns); });
}

// sum of coefficient_i x_i, [1, 1], in order, of x [n, 1].
template <class T, class Number>
Tensor<T> weighted_sum(Tape<T>& tape, Tensor<T> x, const Number* coefficients) {
    const Tensor<T> c = tape.constant(coefficients, x.rows, 1);
    return row_sums(
        tape, {x}, 1, x.rows, [=](ptrdiff_t i) { return c.value[i] * x.value[i]; },
        [=](ptrdiff_t i, T dy) { x.gradient[i] += c.value[i] * dy; });
}

// a x + b y, [1, 1].
template <class T>
Tensor<T> combine(Tape<T>& tape, T a, Tensor<T> x, T b, Tensor<T> y) {
    const Tensor<T> z = tape.make(1, 1);
    z.value[0] = a * x.value[0] + b * y.value[0];
    tape.on_backward(z, [=] {
        *gradient_of(x) += a * z.gradient[0];
        *gradient_of(y) += b * z.gradient[0];
    });
    return z;
}

// ---------------------------------------------------------------------------------------------------------------------
// Optimisers. One struct: LAMB and AdamW differ in where the weight decay goes and in the trust ratio; Adam is AdamW
// without decay.

struct OptimizerConfig {
    enum class Rule { lamb, adamw } rule = Rule::lamb;
    double learning_rate = 1e-3, beta1 = 0.9, beta2 = 0.999, epsilon = 1e-8, weight_decay = 0;  // betas, epsilon: ODT's
    bool always_adapt = false;  // LAMB's trust ratio also without weight decay
    double clip_norm = 0.25;    // of the gradient over all tensors; 0: no clipping
    uint64_t warmup_updates = 10000;
};

struct Optimizer {
    uint64_t updates = 0;
    std::vector<std::vector<float>> first_moment, second_moment;  // one of each per parameter tensor
};

// Linear warm-up: the factor of update n = 0, 1, ... is min((n + 1) / warmup, 1). ODT's code.
inline double warmup_factor(uint64_t update, uint64_t warmup_updates) {
    return update + 1 >= warmup_updates ? 1.0 : static_cast<double>(update + 1) / static_cast<double>(warmup_updates);
}

// Sums of squares are taken in double: eight lanes within a block of 4096, the blocks added in order.
constexpr size_t square_block = 4096;

template <class T>
double block_of_squares(const T* x, size_t n) {
    double lane[8] = {}, sum = 0;
    size_t i = 0;
    for (; i + 8 <= n; i += 8)
        for (size_t j = 0; j < 8; ++j) lane[j] += static_cast<double>(x[i + j]) * x[i + j];
    for (; i < n; ++i) lane[0] += static_cast<double>(x[i]) * x[i];
    for (const double part : lane) sum += part;
    return sum;
}

// f(block, first, count) for each block of [0, n), on all threads.
template <class F>
void for_blocks(Compute& compute, size_t n, int work, F&& f) {
    for_rows(compute, static_cast<int>(divide_up(n, square_block)), work, [&](int begin, int end, int) {
        for (size_t b = static_cast<size_t>(begin); b < static_cast<size_t>(end); ++b)
            f(b, b * square_block, std::min(n - b * square_block, square_block));
    });
}

// x^n by squaring: libm's pow in double differs between processors.
inline double power(double x, uint64_t n) {
    double result = 1;
    for (; n > 0; n /= 2, x *= x)
        if (n % 2 == 1) result *= x;
    return result;
}

// m, v and the step u (before the learning rate) of n weights, from the clipped gradient.
//   m = beta1 m + (1 - beta1) g;  v = beta2 v + (1 - beta2) g^2
//   u = (m / (1 - beta1^t)) / (sqrt(v) / sqrt(1 - beta2^t) + epsilon), in LAMB + weight decay times value
// Written over the gradient, which is not needed any more.
EACH_TARGET inline void adam_step(float* __restrict gradient, float* __restrict m, float* __restrict v,
                                  const float* __restrict value, size_t n, const OptimizerConfig& config, double scale,
                                  double bias1, double bias2) {
    const float beta1 = static_cast<float>(config.beta1), beta2 = static_cast<float>(config.beta2);
    const float one_minus_1 = static_cast<float>(1 - config.beta1), one_minus_2 = static_cast<float>(1 - config.beta2);
    const float clip = static_cast<float>(scale), root_bias2 = static_cast<float>(std::sqrt(bias2));
    const float inverse_bias1 = static_cast<float>(1 / bias1), epsilon = static_cast<float>(config.epsilon);
    const float decay = config.rule == OptimizerConfig::Rule::lamb ? static_cast<float>(config.weight_decay) : 0.0f;
    for (size_t i = 0; i < n; ++i) {
        const float g = gradient[i] * clip;
        m[i] = beta1 * m[i] + one_minus_1 * g;
        v[i] = beta2 * v[i] + one_minus_2 * g * g;
        gradient[i] = m[i] * inverse_bias1 / (std::sqrt(v[i]) / root_bias2 + epsilon) + decay * value[i];
    }
}

// value = shrink value - rate u, u in `gradient`, which is emptied. Returns whether all values are finite.
EACH_TARGET inline bool apply_step(float* __restrict value, float* __restrict gradient, size_t n, float shrink,
                                   float rate) {
    int bad = 0;
    for (size_t i = 0; i < n; ++i) {
        value[i] = shrink * value[i] - rate * gradient[i];
        gradient[i] = 0;
        bad |= !(value[i] - value[i] == 0);  // infinity and NaN are not themselves less themselves
    }
    return !bad;
}

// Adds the gradients of all blocks, in order, to the first, empties the others, and returns the norm of all. Errors:
// nn.not_finite names the tensor.
template <class T>
double join_gradients(Compute& compute, std::vector<Parameter<T>>& parameters) {
    double total = 0;
    std::vector<double> sums;
    for (Parameter<T>& parameter : parameters) {
        const size_t n = parameter.value.size();
        sums.assign(divide_up(n, square_block), 0);
        for_blocks(compute, n, square_block, [&](size_t block, size_t first, size_t count) {
            T* const gradient = parameter.gradient.data() + first;
            for (size_t other = n; other < parameter.gradient.size(); other += n) {
                for (size_t i = 0; i < count; ++i) gradient[i] += gradient[other + i];
                std::fill_n(gradient + other, count, T(0));
            }
            sums[block] = block_of_squares(gradient, count);
        });
        const double squares = std::accumulate(sums.begin(), sums.end(), 0.0);
        if (!std::isfinite(squares)) fail("nn.not_finite", "the gradient of %s is not finite", parameter.name.c_str());
        total += squares;
    }
    return std::sqrt(total);
}

// One update of all parameters from their gradients; returns the gradient's norm before clipping.
// LAMB as ODT has it: per tensor (Q, K, V are one), step times ||value|| / ||u||, and 1 where either norm is 0; skipped
// altogether at weight decay 0 unless always_adapt. Errors: nn.not_finite names the tensor, before anything is changed
// (gradient), or after (value).
inline double update_parameters(Compute& compute, std::vector<Parameter<float>>& parameters, Optimizer& optimizer,
                                const OptimizerConfig& config) {
    const double norm = join_gradients(compute, parameters);
    // PyTorch's clip_grad_norm_: scale by limit / (norm + 1e-6) where that is below 1.
    const double scale = config.clip_norm > 0 ? std::min(1.0, config.clip_norm / (norm + 1e-6)) : 1.0;
    const double learning_rate = config.learning_rate * warmup_factor(optimizer.updates, config.warmup_updates);
    const uint64_t t = ++optimizer.updates;
    const double bias1 = 1 - power(config.beta1, t), bias2 = 1 - power(config.beta2, t);
    const bool lamb = config.rule == OptimizerConfig::Rule::lamb;
    const bool adapt = lamb && (config.weight_decay != 0 || config.always_adapt);
    const float shrink = lamb ? 1.0f : static_cast<float>(1 - learning_rate * config.weight_decay);  // AdamW's decay
    optimizer.first_moment.resize(parameters.size());
    optimizer.second_moment.resize(parameters.size());
    for (size_t p = 0; p < parameters.size(); ++p) {
        Parameter<float>& parameter = parameters[p];
        std::vector<float>&m = optimizer.first_moment[p], &v = optimizer.second_moment[p];
        const size_t n = parameter.value.size();
        m.resize(n);
        v.resize(n);
        const size_t blocks = divide_up(n, square_block);
        std::vector<double> value_squares(blocks), step_squares(blocks);
        std::vector<unsigned char> bad(blocks);
        double trust = 1;
        const auto apply = [&](size_t block, size_t first, size_t count) {
            bad[block] = !apply_step(parameter.value.data() + first, parameter.gradient.data() + first, count, shrink,
                                     static_cast<float>(learning_rate * trust));
        };
        for_blocks(compute, n, 16 * square_block, [&](size_t block, size_t first, size_t count) {
            float *step = parameter.gradient.data() + first, *value = parameter.value.data() + first;
            adam_step(step, m.data() + first, v.data() + first, value, count, config, scale, bias1, bias2);
            if (!adapt) return apply(block, first, count);
            value_squares[block] = block_of_squares(value, count);
            step_squares[block] = block_of_squares(step, count);
        });
        if (adapt) {
            const double value_norm = std::sqrt(std::accumulate(value_squares.begin(), value_squares.end(), 0.0));
            const double step_norm = std::sqrt(std::accumulate(step_squares.begin(), step_squares.end(), 0.0));
            if (value_norm > 0 && step_norm > 0) trust = value_norm / step_norm;
            for_blocks(compute, n, 4 * square_block, apply);
        }
        if (std::count(bad.begin(), bad.end(), 1) > 0)
            fail("nn.not_finite", "parameter %s is not finite after the update", parameter.name.c_str());
    }
    return norm;
}
