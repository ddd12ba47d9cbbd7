// nn.hpp: everything numerical that a decision transformer needs.
//
//   Errors         Error, fail
//   Random numbers philox, Random, Stream: counter-based
//   Threads        Threads: a job shared out in numbered tasks
//   Vector code    vectorised, Vector, lanes_at
//   Products       View; Kernel, compute_tile; matmul; dot
//   Tape           Tensor, Gradient, Tape: differentiation in reverse
//   Operations     linear, layer_norm, dropout_add, attention; each with its backward
//   Parameters     Parameter, initialise
//   Network        Transformer, token_layout, embed_tokens, transformer_block, forward: DT sec. 3, ODT sec. 3
//   Policy heads   log_prob, entropy: squashed Gaussian, categorical, deterministic
//   Optimisers     update_parameters: LAMB, AdamW, Adam
//
// Promises: row-major, last index fastest; float trains, double checks; the same seed gives the same bits for any
// number of threads, on one instruction set (all fused kernels agree, and the portable one with tests/plain.hpp).
// Leaves out: how returns are computed; episodes, environments, files, options.
#pragma once

#include <algorithm>
#include <array>
#include <atomic>
#include <bit>
#include <cmath>
#include <condition_variable>
#include <cstdarg>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
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
#define X86_KERNELS  // in AVX2 and AVX-512, beside the portable ones
#endif
#define ALWAYS_INLINE [[gnu::always_inline]] inline
#define INLINE_LAMBDA __attribute__((always_inline))

// ---------------------------------------------------------------------------------------------------------------------
// Errors. Every failure is one sentence for the person at the terminal (what, where, expected and got, what to do) and
// one stable id ("safetensors.truncated"), by which callers and tests know it.

struct Error : std::runtime_error {
    std::string id;
    Error(std::string error_id, const std::string& sentence) : std::runtime_error(sentence), id(std::move(error_id)) {}
};

// Throws an Error. The sentence is formatted as by printf and may have any length.
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

// Philox4x32-10. Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011, section 3.3.
// words [Count, 4]: the outputs for `Count` counters that differ in their first word: counter[0], counter[0] + 1, ...
// The loops over the counters are plain so that the compiler turns them into vectors.
template <uint32_t Count>
ALWAYS_INLINE void philox_words(uint32_t* words, const Words4& counter, uint32_t key0, uint32_t key1) {
    uint32_t c[4][Count];
    for (size_t word = 0; word < 4; ++word) std::fill_n(c[word], Count, counter[word]);
    for (uint32_t i = 0; i < Count; ++i) c[0][i] += i;
    for (int round = 0; round < 10; ++round) {
        for (uint32_t i = 0; i < Count; ++i) {
            const uint64_t product0 = uint64_t{0xD2511F53} * c[0][i], product1 = uint64_t{0xCD9E8D57} * c[2][i];
            c[0][i] = static_cast<uint32_t>(product1 >> 32) ^ c[1][i] ^ key0;
            c[2][i] = static_cast<uint32_t>(product0 >> 32) ^ c[3][i] ^ key1;
            c[1][i] = static_cast<uint32_t>(product1);
            c[3][i] = static_cast<uint32_t>(product0);
        }
        key0 += 0x9E3779B9;  // golden ratio
        key1 += 0xBB67AE85;  // sqrt(3) - 1
    }
    for (uint32_t i = 0; i < Count; ++i)
        for (size_t word = 0; word < 4; ++word) words[4 * i + word] = c[word][i];
}

// One counter's 128 bits.
inline Words4 philox(const Words4& counter, uint32_t key0, uint32_t key1) {
    Words4 words;
    philox_words<1>(words.data(), counter, key0, key1);
    return words;
}

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

    // The words of `index` to `index` + Count - 1, one after the other: words [Count, 4].
    template <uint32_t Count>
    ALWAYS_INLINE void many_words(uint32_t* words, uint64_t step, uint32_t index, uint32_t site) const {
        const Words4 counter = {index, site, static_cast<uint32_t>(step), static_cast<uint32_t>(step >> 32)};
        philox_words<Count>(words, counter, seed, stream);
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

    // Standard normal by Box and Muller, from words 2 and 3; 24 bits reach 5.8 standard deviations.
    // logf and cosf of glibc 2.36 give the same bits with FMA instructions and without, measured over all 2^24 values
    // of u and of the angle; the double functions of libm do not. Another library may differ in the last bit.
    float normal(uint64_t step, uint32_t index, uint32_t site = 0) const {
        const Words4 w = words(step, index, site);
        const float u = (static_cast<float>(w[2] >> 8) + 1.0f) * 0x1p-24f;  // (0, 1]
        const float angle = static_cast<float>(w[3] >> 8) * (0x1p-24f * 6.2831853f);
        return std::sqrt(-2.0f * std::log(u)) * std::cos(angle);
    }
};

// ---------------------------------------------------------------------------------------------------------------------
// Threads. A fixed set of workers that share out numbered tasks. Which worker runs a task is left to chance; what a
// task computes must depend on its number alone, so that results are the same for any number of threads.
//
// A job: run() publishes f and the number of tasks under the lock and wakes the workers; everyone, the caller included,
// takes the next task number until none is left; who finishes the last task wakes the caller. A worker that wakes late
// finds no task and sleeps again, so the caller never waits for a worker that has nothing to do.

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
        } catch (...) {  // no memory for one: those that have started must end before they are destroyed
            stop();
            throw;
        }
    }
    ~Threads() { stop(); }
    Threads(const Threads&) = delete;
    Threads& operator=(const Threads&) = delete;

    int count() const { return pretended > 0 ? pretended : static_cast<int>(workers_.size()) + 1; }

    // Calls f(task, worker) once for each task in [0, tasks) and returns when all are done; 0 <= worker < count().
    // f must not call run() and must not throw: an exception that leaves it would end the process in a worker, and in
    // the calling thread leave the workers with a job that is gone. What may throw, an allocation say, is done before
    // run(), or caught inside f.
    // `serial`: the calling thread runs all tasks alone.
    // Errors: nn.stopped, as soon as asked_to_stop() says yes; the tasks that no thread has begun are then left out.
    template <class F>
    void run(int tasks, F&& f, bool serial = false) {
        if (serial || workers_.empty() || tasks < 2) {
            if (rehearse && !serial && tasks > 1) return rehearse(tasks, std::ref(f));
            for (int task = 0; task < tasks; ++task) {
                if (asked_to_stop && asked_to_stop()) fail_stopped();
                f(task, 0);
            }
            return;
        }
        {
            const std::lock_guard lock(mutex_);
            job_ = [&f](int task, int worker) { f(task, worker); };
            tasks_ = tasks;
            next_task_ = 0;
            unfinished_ = tasks;
            ++jobs_;
        }
        wake_.notify_all();
        const bool stopped = take_tasks(0);
        poll([this] { return unfinished_ == 0; });
        std::unique_lock lock(mutex_);
        done_.wait(lock, [this] { return unfinished_ == 0; });
        if (stopped) fail_stopped();
    }

    // Set where work may be abandoned; run() calls it before each task of the calling thread.
    std::function<bool()> asked_to_stop;

    // For a forecast of one thread (`wodtem bench`): work is cut as for `pretended` threads, and rehearse() is handed
    // each job that they would share; it calls f(task, 0) for every task, in any order.
    int pretended = 0;
    std::function<void(int tasks, const std::function<void(int, int)>& f)> rehearse;

  private:
    // Waits until condition() holds, but for some ten microseconds at most. To be woken by the system takes about as
    // long, which is more than many a job of a small network.
    template <class Condition>
    static void poll(Condition condition) {
        for (int i = 0; i < 300 && !condition(); ++i) {
#if defined(__x86_64__)
            __builtin_ia32_pause();
#endif
        }
    }

    [[noreturn]] static void fail_stopped() { fail("nn.stopped", "the computation was stopped on request"); }

    // Runs tasks of the current job until none is left. The job itself changes only after all its tasks are finished,
    // so it is read without the lock. Returns whether the others were given up because someone asked to stop.
    bool take_tasks(int worker) {
        std::unique_lock lock(mutex_);
        while (next_task_ < tasks_) {
            if (worker == 0 && asked_to_stop && asked_to_stop()) {
                unfinished_ -= tasks_ - next_task_;
                next_task_ = tasks_;
                return true;
            }
            const int task = next_task_++;
            lock.unlock();
            job_(task, worker);
            lock.lock();
            if (--unfinished_ == 0) done_.notify_one();
        }
        return false;
    }

    void work(int worker) {
        uint64_t seen = 0;  // jobs
        while (true) {
            poll([&] { return jobs_ != seen; });
            {
                std::unique_lock lock(mutex_);
                wake_.wait(lock, [&] { return jobs_ != seen; });
                if (stop_) return;
                seen = jobs_;
            }
            take_tasks(worker);
        }
    }

    void stop() {
        {
            const std::lock_guard lock(mutex_);
            stop_ = true;
            ++jobs_;
        }
        wake_.notify_all();
        for (std::thread& worker : workers_) worker.join();
    }

    std::vector<std::thread> workers_;
    std::mutex mutex_;  // guards all that follows
    std::condition_variable wake_, done_;
    std::function<void(int, int)> job_;
    int tasks_ = 0, next_task_ = 0;
    bool stop_ = false;
    std::atomic<int> unfinished_{0};  // tasks of the current job; atomic, as is jobs_, for poll()
    std::atomic<uint64_t> jobs_{0};   // begun so far, the order to stop among them
};

// n / by, rounded up; n >= 0, by > 0.
template <class N>
N divide_up(N n, std::type_identity_t<N> by) {
    return (n + by - 1) / by;
}

// ---------------------------------------------------------------------------------------------------------------------
// Vector code. The loops that cost most are compiled once for each generation of x86 processors, for float; double,
// which only checks, has the portable version alone. Every operation is rounded by itself (-ffp-contract=off), and the
// order of additions is written out, so all versions give the same bits.

template <int Count>
using Lanes = std::integral_constant<int, Count>;

#ifdef X86_KERNELS
template <class F>
__attribute__((target("arch=x86-64-v4"))) void run_in_avx512(const F& f) {
    f(Lanes<16>{});
}
template <class F>
__attribute__((target("arch=x86-64-v3"))) void run_in_avx2(const F& f) {
    f(Lanes<8>{});
}
inline const bool has_avx512 = __builtin_cpu_supports("x86-64-v4"), has_avx2 = __builtin_cpu_supports("x86-64-v3");
#endif

// Calls f(lanes) in the version for this processor. `lanes`: an integral constant, how many floats vector code should
// take at a time. f must be a lambda with INLINE_LAMBDA, or it would be compiled by itself, without those vectors.
template <class T, class F>
void vectorised(const F& f) {
#ifdef X86_KERNELS
    if constexpr (std::is_same_v<T, float>) {
        if (has_avx512) return run_in_avx512(f);
        if (has_avx2) return run_in_avx2(f);
    }
#endif
    f(Lanes<8>{});
}

// `Count` numbers that are added and multiplied lane by lane; `Unaligned`: at any address.
template <class T, int Count>
struct VectorOf {
    typedef T Aligned __attribute__((vector_size(Count * sizeof(T))));
    typedef Aligned Unaligned __attribute__((aligned(alignof(T)), may_alias));
};
template <class T, int Count>
using Vector = typename VectorOf<T, Count>::Aligned;

// The `Count` numbers from x on, as a vector to read or write.
template <int Count, class T>
ALWAYS_INLINE const typename VectorOf<T, Count>::Unaligned& lanes_at(const T* x) {
    return *reinterpret_cast<const typename VectorOf<T, Count>::Unaligned*>(x);
}
template <int Count, class T>
ALWAYS_INLINE typename VectorOf<T, Count>::Unaligned& lanes_at(T* x) {
    return *reinterpret_cast<typename VectorOf<T, Count>::Unaligned*>(x);
}

// ---------------------------------------------------------------------------------------------------------------------
// Matrix products. C [M, N] = or += A [M, K] B [K, N]. Index order everywhere: row-major, last index fastest.

// A matrix inside a larger one: element (i, j) at data[i * stride + j], or at data[j * stride + i] if transposed.
template <class T>
struct View {
    T* data;
    int stride;
    bool transposed = false;
    bool weight = false;  // as B: a model's weight, which does not change while a FrozenWeights lives
    T& operator()(int i, int j) const {
        return transposed ? data[static_cast<ptrdiff_t>(j) * stride + i] : data[static_cast<ptrdiff_t>(i) * stride + j];
    }
};

// The order of additions is part of the definition: sums of `sum_block` products, each from zero and in order of k, are
// added to C in order. It bounds the error for long K by about (sum_block + K / sum_block) * 2^-24 * sum |a b|, and
// every kernel follows it, so an element does not depend on M, N, tile shapes or threads.
constexpr int sum_block = 256;

// Whether a result replaces what is in its place or is added to it.
enum class Store { overwrite, accumulate };

// ---------------------------------------------------------------------------------------------------------------------
// Kernels. A kernel computes one tile of C from packed panels of A and B: a panel holds the elements of a few rows of A
// (or columns of B), called its lines, in the order in which the kernel reads them: [k, line].

// Where a tile of C lies and what happens to it: the upper left rows x columns of the tile are written, or added to.
struct Tile {
    float* c;
    int stride;
    int rows, columns;
    Store store;
};

// Computes a tile from a [depth, tile_rows] and b [depth, tile_columns], 1 <= depth <= sum_block.
using TileFunction = void (*)(const Tile& tile, const void* a, const void* b, int depth);

// Copies `used` lines of `depth` elements into a panel and fills it up with lines of zeros. Element (k, line) of the
// panel is view(first_k + k, first_line + line).
using PackFunction = void (*)(void* panel, View<const float> view, int first_k, int first_line, int depth, int used);

// How a kernel adds a product to a sum: rounding twice, as matmul_plain in tests/plain.hpp does, or once; or A and B
// are rounded to bf16 and sums stay float, by the processor or imitated, see bf16_multiply_add.
enum class Multiply { plain, fused, bf16, bf16_portable };
constexpr bool in_bf16(Multiply how) { return how == Multiply::bf16 || how == Multiply::bf16_portable; }
constexpr int k_a_word(Multiply how) { return in_bf16(how) ? 2 : 1; }  // numbers in a word of 4 bytes of a panel

// One way to compute the products of float matrices. The sharing-out below knows a kernel by this record alone; panels
// are opaque to it.
struct Kernel {
    const char* name;
    Multiply how;
    int tile_rows, tile_columns;
    bool (*supported)();  // by this machine
    PackFunction pack_a, pack_b;
    TileFunction tile;

    const char* precision() const { return in_bf16(how) ? "bf16" : "fp32"; }
    // Kernels of equal arithmetic give the same bits.
    const char* arithmetic() const { return in_bf16(how) ? "bf16" : how == Multiply::fused ? "fused" : "plain"; }
    // Bytes of panels of `lines` lines in all, `depth` values of k each.
    size_t panel_bytes(int lines, int depth) const { return size_t{4} * lines * divide_up(depth, k_a_word(how)); }
};

// bf16 is the upper half of a float: 8 bits of mantissa, the leading one included. Rounds to nearest even; NaN stays,
// and subnormal numbers become 0, as in x86's conversions (Intel SDM, vcvtne2ps2bf16).
ALWAYS_INLINE uint32_t to_bf16(float x) {
    const uint32_t bits = std::bit_cast<uint32_t>(std::abs(x) < 0x1p-126f ? std::copysign(0.0f, x) : x);
    return x == x ? (bits + 0x7fff + (bits >> 16 & 1)) >> 16 : bits >> 16 | 0x40;
}

// sum + a_odd b_odd, rounded, then + a_even b_even, rounded, for words that hold bf16 of an odd k in the upper half and
// of the even k before it in the lower: the definition of the bf16 products. It is what x86's vdpbf16ps computes in
// each lane (Intel SDM): subnormal inputs, sums and results count as zero.
ALWAYS_INLINE float bf16_multiply_add(float sum, float a_word, float b_word) {
    const auto normal = [](float x) { return std::abs(x) < 0x1p-126f ? std::copysign(0.0f, x) : x; };
    const auto value = [=](uint32_t bits) { return normal(std::bit_cast<float>(bits)); };
    const uint32_t a = std::bit_cast<uint32_t>(a_word), b = std::bit_cast<uint32_t>(b_word);
    sum = normal(std::fma(value(a & 0xffff0000), value(b & 0xffff0000), normal(sum)));
    return normal(std::fma(value(a << 16), value(b << 16), sum));
}

// sum += a * b in each lane. GCC 12 has no portable vector multiply-add, so two forms are one instruction by name.
template <Multiply How, class V>
ALWAYS_INLINE void multiply_add(V& sum, const V& a, const V& b) {
#ifdef X86_KERNELS
    if constexpr (How == Multiply::fused) asm("vfmadd231ps %2, %1, %0" : "+v"(sum) : "v"(a), "v"(b));
    if constexpr (How == Multiply::bf16) asm("vdpbf16ps %2, %1, %0" : "+v"(sum) : "v"(a), "v"(b));
#endif
    if constexpr (How == Multiply::plain) sum += a * b;
    if constexpr (How == Multiply::bf16_portable)
        for (size_t i = 0; i < sizeof(V) / sizeof(float); ++i) sum[i] = bf16_multiply_add(sum[i], a[i], b[i]);
}

// TileFunction: `Rows` rows of `Vectors` vectors of `Width` sums, held in registers while k runs, word by word. One
// step of k, with two vectors:
//
//              row_of_b[0]   row_of_b[1]      read once from the panel of B
//     a[0]     sum[0][0]     sum[0][1]        each a[r] is broadcast to all lanes, and
//     a[1]     sum[1][0]     sum[1][1]        sum[r][v] += a[r] * row_of_b[v]:
//     ...                                     Rows * Vectors multiply-adds for Rows + Vectors loads
//
// 12 x 2 sums fill 24 of AVX-512's 32 registers and 6 x 2 sums 12 of AVX2's 16; the others hold A's and B's elements.
template <int Rows, int Vectors, int Width, Multiply How>
ALWAYS_INLINE void compute_tile(const Tile& tile, const void* a_panel, const void* b_panel, int depth) {
    constexpr int columns = Width * Vectors;
    const float *a = static_cast<const float*>(a_panel), *b = static_cast<const float*>(b_panel);
    // C may be far from the cache, and is needed only at the end.
    for (int r = 0; r < tile.rows; ++r)
        for (int j = 0; j < tile.columns; j += 16)
            __builtin_prefetch(tile.c + static_cast<ptrdiff_t>(r) * tile.stride + j, 1);
    Vector<float, Width> sum[Rows][Vectors] = {};
    for (int k = 0; k < depth; k += k_a_word(How)) {
        Vector<float, Width> row_of_b[Vectors];
#pragma GCC unroll 4
        for (int v = 0; v < Vectors; ++v) {
            row_of_b[v] = lanes_at<Width>(b + v * Width);
            __builtin_prefetch(b + 16 * columns + v * Width);  // with few rows of A, B comes from memory
        }
#pragma GCC unroll 16
        for (int r = 0; r < Rows; ++r) {
            // A broadcast: the word less zero in each lane, as a whole number, which changes no bit of it.
            const auto word_of_a =
                reinterpret_cast<Vector<float, Width>>(std::bit_cast<int32_t>(a[r]) - Vector<int32_t, Width>{});
#pragma GCC unroll 4
            for (int v = 0; v < Vectors; ++v) multiply_add<How>(sum[r][v], word_of_a, row_of_b[v]);
        }
        a += Rows;
        b += columns;
    }
    if (tile.rows == Rows && tile.columns == columns) {
#pragma GCC unroll 16
        for (int r = 0; r < Rows; ++r)
#pragma GCC unroll 4
            for (int v = 0; v < Vectors; ++v) {
                float* to = tile.c + static_cast<ptrdiff_t>(r) * tile.stride + v * Width;
                lanes_at<Width>(to) = (tile.store == Store::accumulate ? lanes_at<Width>(to) + sum[r][v] : sum[r][v]);
            }
        return;
    }
    // The tile sticks out of C: only its upper left part is copied.
    float whole[Rows * columns];
    std::memcpy(whole, sum, sizeof whole);
    for (int r = 0; r < tile.rows; ++r)
        for (int j = 0; j < tile.columns; ++j) {
            float& to = tile.c[static_cast<ptrdiff_t>(r) * tile.stride + j];
            to = tile.store == Store::accumulate ? to + whole[r * columns + j] : whole[r * columns + j];
        }
}

// to[j * to_stride + i] = from[i * from_stride + j] for i, j < 4.
ALWAYS_INLINE void transpose_4x4(float* to, int to_stride, const float* from, int from_stride) {
    Vector<float, 4> row[4];
    for (ptrdiff_t i = 0; i < 4; ++i) row[i] = lanes_at<4>(from + i * from_stride);
    // First pairs of elements of two rows, then those pairs: a = (00 10 01 11), b = (20 30 21 31), ...
    const auto a = __builtin_shufflevector(row[0], row[1], 0, 4, 1, 5),
               b = __builtin_shufflevector(row[2], row[3], 0, 4, 1, 5),
               c = __builtin_shufflevector(row[0], row[1], 2, 6, 3, 7),
               d = __builtin_shufflevector(row[2], row[3], 2, 6, 3, 7);
    const ptrdiff_t stride = to_stride;
    lanes_at<4>(to) = __builtin_shufflevector(a, b, 0, 1, 4, 5);
    lanes_at<4>(to + stride) = __builtin_shufflevector(a, b, 2, 3, 6, 7);
    lanes_at<4>(to + 2 * stride) = __builtin_shufflevector(c, d, 0, 1, 4, 5);
    lanes_at<4>(to + 3 * stride) = __builtin_shufflevector(c, d, 2, 3, 6, 7);
}

// PackFunction for floats: the panel is [depth, Width].
template <int Width>
void pack_floats(void* to, View<const float> view, int first_k, int first_line, int depth, int used) {
    float* const panel = static_cast<float*>(to);
    if (used < Width) std::fill_n(panel, depth * Width, 0.0f);
    if (!view.transposed) {  // the lines lie side by side: copy along them
        for (int k = 0; k < depth; ++k) {
            const float* const row = &view(first_k + k, first_line);
            if (used == Width)  // the size is constant, so that this is a few vectors
                std::memcpy(panel + k * Width, row, sizeof(float) * Width);
            else
                for (int line = 0; line < used; ++line) panel[k * Width + line] = row[line];
        }
        return;
    }
    for (int first = 0; first < used; first += 4) {  // the lines lie along k: transpose blocks of 4 x 4
        const int lines = std::min(4, used - first), whole = lines == 4 ? depth / 4 * 4 : 0;
        for (int k = 0; k < whole; k += 4)
            transpose_4x4(panel + k * Width + first, Width, &view(first_k + k, first_line + first), view.stride);
        for (int line = first; line < first + lines; ++line)
            for (int k = whole; k < depth; ++k) panel[k * Width + line] = view(first_k + k, first_line + line);
    }
}

// Two numbers of successive k as a word: the even k in the lower half.
ALWAYS_INLINE float bf16_word(float even, float odd) {
    return std::bit_cast<float>(to_bf16(even) | to_bf16(odd) << 16);
}

#ifdef X86_KERNELS
// both = to_bf16 of L + L numbers: first's, then second's.
template <int L>
ALWAYS_INLINE void to_bf16(Vector<uint16_t, 2 * L>& both, const float* first, const float* second) {
    const Vector<float, L> low = lanes_at<L>(first), high = lanes_at<L>(second);
    asm("vcvtne2ps2bf16 %1, %2, %0" : "=v"(both) : "v"(low), "v"(high));
}
#endif

// words [pairs] of numbers [2 pairs] that lie side by side in order of k.
template <Multiply How>
ALWAYS_INLINE void bf16_words_along(float* words, const float* from, int pairs) {
    int w = 0;
#ifdef X86_KERNELS
    // 32 numbers in order of k become 32 bf16 in order of k, which are 16 words as they lie.
    if constexpr (How == Multiply::bf16)
        for (; w + 16 <= pairs; w += 16) {
            Vector<uint16_t, 32> both;
            to_bf16<16>(both, from + 2 * w, from + 2 * w + 16);
            lanes_at<16>(words + w) = reinterpret_cast<Vector<float, 16>>(both);
        }
#endif
    for (; w < pairs; ++w) words[w] = bf16_word(from[2 * w], from[2 * w + 1]);
}

// words [n] of two rows [n], of an even k and the next. L: how many at a time; it divides the width of a panel, so that
// of a whole panel none is left over.
template <Multiply How, int L>
ALWAYS_INLINE void bf16_words_across(float* words, const float* even, const float* odd, int n) {
    int i = 0;
#ifdef X86_KERNELS
    // The L of the even row come before the L of the odd row; interleaved they are L words.
    if constexpr (How == Multiply::bf16)
        for (; i + L <= n; i += L) {
            Vector<uint16_t, 2 * L> both, order;
            to_bf16<L>(both, even + i, odd + i);
            for (int lane = 0; lane < 2 * L; ++lane)  // 0, L, 1, L + 1, ...
                order[lane] = static_cast<uint16_t>(lane / 2 + lane % 2 * L);
            lanes_at<L>(words + i) = reinterpret_cast<Vector<float, L>>(__builtin_shuffle(both, order));
        }
#endif
    for (; i < n; ++i) words[i] = bf16_word(even[i], odd[i]);
}

// PackFunction for bf16: the panel is [depth / 2, Width] words, of k and k + 1; if depth is odd, the last has one zero.
template <int Width, Multiply How>
ALWAYS_INLINE void pack_bf16(void* to, View<const float> view, int first_k, int first_line, int depth, int used) {
    const int pairs = depth / 2, words = divide_up(depth, 2), last = first_k + depth - 1;
    float buffer[sum_block / 2 * Width];  // words in the order of the view: [words, Width], or [Width, words]
    const ptrdiff_t per_word = view.transposed ? 1 : Width, per_line = view.transposed ? words : 1;
    for (int line = 0; view.transposed && line < used; ++line)
        bf16_words_along<How>(buffer + line * words, &view(first_k, first_line + line), pairs);
    for (int w = 0; !view.transposed && w < pairs; ++w)
        bf16_words_across<How, Width % 16 ? 4 : 16>(buffer + w * Width, &view(first_k + 2 * w, first_line),
                                                    &view(first_k + 2 * w + 1, first_line), used);
    for (int line = 0; pairs < words && line < used; ++line)
        buffer[pairs * per_word + line * per_line] = bf16_word(view(last, first_line + line), 0);
    pack_floats<Width>(to, {buffer, view.transposed ? words : Width, view.transposed}, 0, 0, words, used);
}

// The kernels' records; tile and packing must be compiled for a kernel's instructions.
#ifdef X86_KERNELS
__attribute__((target("avx512f"))) inline void tile_avx512(const Tile& tile, const void* a, const void* b, int depth) {
    compute_tile<12, 2, 16, Multiply::fused>(tile, a, b, depth);
}
inline const Kernel kernel_avx512(
    "avx512", Multiply::fused, 12, 32, [] { return __builtin_cpu_supports("avx512f") != 0; }, pack_floats<12>,
    pack_floats<32>, tile_avx512);

__attribute__((target("avx2,fma"))) inline void tile_avx2(const Tile& tile, const void* a, const void* b, int depth) {
    compute_tile<6, 2, 8, Multiply::fused>(tile, a, b, depth);
}
inline const Kernel kernel_avx2(
    "avx2", Multiply::fused, 6, 16, [] { return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"); },
    pack_floats<6>, pack_floats<16>, tile_avx2);

#define BF16_TARGET __attribute__((target("arch=x86-64-v4,avx512bf16")))
BF16_TARGET inline void tile_avx512_bf16(const Tile& tile, const void* a, const void* b, int depth) {
    compute_tile<12, 2, 16, Multiply::bf16>(tile, a, b, depth);
}
template <int Width>
BF16_TARGET void pack_bf16_avx512(void* to, View<const float> view, int first_k, int first_line, int depth, int used) {
    pack_bf16<Width, Multiply::bf16>(to, view, first_k, first_line, depth, used);
}
inline const Kernel kernel_avx512_bf16(
    "avx512", Multiply::bf16, 12, 32, [] { return has_avx512 && __builtin_cpu_supports("avx512bf16"); },
    pack_bf16_avx512<12>, pack_bf16_avx512<32>, tile_avx512_bf16);
#endif

inline const Kernel kernel_portable(
    "portable", Multiply::plain, 4, 8, [] { return true; }, pack_floats<4>, pack_floats<8>,
    compute_tile<4, 2, 4, Multiply::plain>);
inline const Kernel kernel_portable_bf16(
    "portable", Multiply::bf16_portable, 4, 8, [] { return true; }, pack_bf16<4, Multiply::bf16_portable>,
    pack_bf16<8, Multiply::bf16_portable>, compute_tile<4, 2, 4, Multiply::bf16_portable>);

// All kernels of this program, of each precision the best first.
inline const Kernel* const kernels[] = {
#ifdef X86_KERNELS
    &kernel_avx512, &kernel_avx2, &kernel_avx512_bf16,
#endif
    &kernel_portable, &kernel_portable_bf16};

// The fastest kernel for fp32, the default precision, that this machine supports.
inline const Kernel& best_kernel() {
    return **std::find_if(std::begin(kernels), std::end(kernels), [](const Kernel* k) { return k->supported(); });
}

// ---------------------------------------------------------------------------------------------------------------------
// Products from tiles: packing and sharing out.
//
//     B [K, N], packed in panels of tile_columns, 256 values of k a step        by all threads
//     for each block of C:                                                      by one thread
//         for each step:  its rows of A, [192, 256], packed in panels of tile_rows
//             for each panel of B, for each panel of A:  one tile of C          by the kernel
//
// A tile's sums stay in registers for 256 steps of k; the block of A fits in a core's second cache and is read once for
// each panel of B, and the panel of B, in the first cache, once for each panel of A.

// Scratch memory on cache lines (a vector load that straddles two costs two). It grows to the largest size asked for;
// its contents last until room() is called again.
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

// The packed form of a weight, for as long as a FrozenWeights lives.
struct PackedWeight {
    Buffer panels;
    bool valid = false;
};

// Threads, kernel and scratch memory: what every operation below needs in order to run.
struct Compute {
    static constexpr int block_rows = 192;  // of A, that a task packs: fits a core's second cache
    const Kernel& kernel;
    Threads threads;
    Buffer packed_b;
    std::map<std::tuple<const float*, int, bool, int, int>, PackedWeight> weights;  // by data, stride, transposed, K, N
    bool weights_frozen = false;
    std::vector<Buffer> scratch;               // one per worker, for a task: a block of A in panels, a head's rows
    Buffer sums;                               // of block_sums
    std::function<bool()> asked_to_stop = {};  // see FrozenWeights
    Compute(const Kernel& chosen, int thread_count)
        : kernel(chosen),
          threads(thread_count),
          scratch(static_cast<size_t>(thread_count)) {}

    // Sees to it that room(bytes) of each worker's scratch memory allocates nothing in the tasks to come.
    void reserve_scratch(size_t bytes) {
        for (Buffer& buffer : scratch) buffer.room(bytes);
    }
};

// While one lives, no weight may change (View::weight): products pack each weight once and use its panels again. As
// long as no weight changes work can be abandoned without loss, so Compute::asked_to_stop holds then: Threads::run()
// fails with nn.stopped once it says yes.
struct FrozenWeights {
    Compute& compute;
    explicit FrozenWeights(Compute& c) : compute(c) {
        for (auto& [key, weight] : compute.weights) weight.valid = false;
        compute.weights_frozen = true;
        compute.threads.asked_to_stop = compute.asked_to_stop;
    }
    ~FrozenWeights() {
        compute.weights_frozen = false;
        compute.threads.asked_to_stop = nullptr;
    }
    FrozenWeights(const FrozenWeights&) = delete;
    FrozenWeights& operator=(const FrozenWeights&) = delete;
};

// Rows and columns of C that a task works on.
struct Block {
    int first_row, end_row, first_column, end_column;
};

// What is done to each element of C after its last addition, while it is in a core's cache: the bias of its column is
// added, then negative values become 0. The slope of ReLU at 0 is 0, as in PyTorch; NaN stays.
template <class T>
struct Epilogue {
    const T* bias = nullptr;  // [N]; null: none
    bool relu = false;
};

template <class T>
void apply_epilogue(View<T> c, const Epilogue<T>& epilogue, const Block& block) {
    if (!epilogue.bias && !epilogue.relu) return;
    vectorised<T>([&](auto) INLINE_LAMBDA {
        for (int i = block.first_row; i < block.end_row; ++i) {
            T* row = &c(i, 0);
            for (int j = block.first_column; epilogue.bias && j < block.end_column; ++j) row[j] += epilogue.bias[j];
            for (int j = block.first_column; epilogue.relu && j < block.end_column; ++j)
                row[j] = row[j] < 0 ? T(0) : row[j];
        }
    });
}

// Packs lines [first_line, end_line) of A or B, k in [first_k, first_k + depth), into panels of `width` lines: along
// the lines where these run along memory, else 32 k of all panels at a time, which lie side by side.
inline void pack_panels(const Kernel& kernel, PackFunction pack, int width, char* to, View<const float> view,
                        int first_k, int depth, int first_line, int end_line) {
    const int slice = view.transposed ? depth : 32;
    for (int k = 0; k < depth; k += slice) {
        char* panel = to + kernel.panel_bytes(width, k);
        for (int line = first_line; line < end_line; line += width) {
            pack(panel, view, first_k + k, line, std::min(slice, depth - k), std::min(width, end_line - line));
            panel += kernel.panel_bytes(width, depth);
        }
    }
}

// c [M, N] = or += a [M, K] b [K, N], then the epilogue (double: tests/plain.hpp). Two rounds of tasks: B is packed,
// in steps of sum_block k; then each task computes a block of C, packing its rows of A on the way. A frozen weight is
// packed once for many products.
inline void matmul(Compute& compute, View<float> c, View<const float> a, View<const float> b, int M, int N, int K,
                   Store store, Epilogue<float> epilogue = {}) {
    if (M == 0 || N == 0) return;
    if (K == 0 && store == Store::overwrite)  // an empty sum
        for (int i = 0; i < M; ++i) std::fill_n(&c(i, 0), N, 0.0f);
    const Kernel& kernel = compute.kernel;
    const int threads = compute.threads.count();
    const bool serial = static_cast<double>(M) * N * K < 5e4;  // below that, sharing out costs more than it saves
    // C in tiles, tiles in blocks: of rows, and for a wide C with few rows also of columns, as equal as tiles allow.
    const int tiles = divide_up(M, kernel.tile_rows), panels = divide_up(N, kernel.tile_columns);
    const int fewest = std::max(divide_up(tiles, Compute::block_rows / kernel.tile_rows), serial ? 1 : 4);
    const int row_blocks = std::min(tiles, serial ? fewest : divide_up(fewest, threads) * threads);
    const int widest = serial ? 1 : std::max(1, panels / 4);
    const int column_blocks = std::clamp(std::max(8, 4 * threads) / row_blocks, 1, widest);

    PackedWeight* cached = nullptr;
    if (b.weight && compute.weights_frozen) cached = &compute.weights[{b.data, b.stride, b.transposed, K, N}];
    Buffer& buffer = cached ? cached->panels : compute.packed_b;
    const bool packed_before = cached && cached->valid;
    const int steps = divide_up(K, sum_block), panels_a_task = std::max(1, panels / std::max(8, threads));
    const int tasks_a_step = divide_up(panels, panels_a_task);
    const size_t step_bytes = kernel.panel_bytes(panels * kernel.tile_columns, std::min(K, sum_block));
    char* const packed = buffer.room(step_bytes * steps);
    const auto pack_some_panels = [&](int task, int) {
        const int step = task / tasks_a_step, first_k = step * sum_block, depth = std::min(sum_block, K - first_k);
        const int line = task % tasks_a_step * panels_a_task * kernel.tile_columns;
        const int end_line = std::min(N, line + panels_a_task * kernel.tile_columns);
        char* const to = packed + step * step_bytes + kernel.panel_bytes(line, depth);
        pack_panels(kernel, kernel.pack_b, kernel.tile_columns, to, b, first_k, depth, line, end_line);
    };
    if (!packed_before) compute.threads.run(steps * tasks_a_step, pack_some_panels, serial);
    if (cached) cached->valid = true;

    const auto multiply = [&](int task, int worker) {
        const int i = task / column_blocks, j = task % column_blocks;
        const auto row = [&](int n) { return std::min(M, tiles * n / row_blocks * kernel.tile_rows); };
        const auto column = [&](int n) { return std::min(N, panels * n / column_blocks * kernel.tile_columns); };
        const Block block = {row(i), row(i + 1), column(j), column(j + 1)};
        char* const packed_a = compute.scratch[worker].room(kernel.panel_bytes(Compute::block_rows, sum_block));
        const View<const float> a_lines = {a.data, a.stride, !a.transposed};  // the lines of A are its rows
        for (int step = 0; step < steps; ++step) {
            const int first_k = step * sum_block, depth = std::min(sum_block, K - first_k);
            pack_panels(kernel, kernel.pack_a, kernel.tile_rows, packed_a, a_lines, first_k, depth, block.first_row,
                        block.end_row);
            for (int n = block.first_column; n < block.end_column; n += kernel.tile_columns)
                for (int m = block.first_row; m < block.end_row; m += kernel.tile_rows) {
                    const Tile tile = {&c(m, n), c.stride, std::min(kernel.tile_rows, block.end_row - m),
                                       std::min(kernel.tile_columns, block.end_column - n),
                                       step > 0 ? Store::accumulate : store};
                    kernel.tile(tile, packed_a + kernel.panel_bytes(m - block.first_row, depth),
                                packed + step * step_bytes + kernel.panel_bytes(n, depth), depth);
                }
        }
        apply_epilogue(c, epilogue, block);
    };
    compute.reserve_scratch(kernel.panel_bytes(Compute::block_rows, sum_block));
    compute.threads.run(row_blocks * column_blocks, multiply, serial);
}

// ---------------------------------------------------------------------------------------------------------------------
// Dot products.

// a . b, of [n] each. The order of additions is part of the definition: lane l of 16 sums the products l, l + 16, ...
// in order; the lanes are folded in halves (lane l with l + 8, then with l + 4, l + 2, l + 1); the products beyond the
// last whole 16 are summed in order and added at the end. In a single chain each addition would wait for the one
// before. Width: how many lanes a vector has.
template <int Width = 8, class T>
ALWAYS_INLINE T dot(const T* a, const T* b, ptrdiff_t n) {
    Vector<T, Width> sum[16 / Width] = {};
    ptrdiff_t i = 0;
    for (; i + 16 <= n; i += 16)
        for (ptrdiff_t h = 0; h < 16; h += Width)
            sum[h / Width] += lanes_at<Width>(a + i + h) * lanes_at<Width>(b + i + h);
    Vector<T, 8> eight;
    if constexpr (Width == 16)
        eight = __builtin_shufflevector(sum[0], sum[0], 0, 1, 2, 3, 4, 5, 6, 7) +
                __builtin_shufflevector(sum[0], sum[0], 8, 9, 10, 11, 12, 13, 14, 15);
    else
        eight = sum[0] + sum[1];
    const auto four =
        __builtin_shufflevector(eight, eight, 0, 1, 2, 3) + __builtin_shufflevector(eight, eight, 4, 5, 6, 7);
    T rest = 0;
    for (; i < n; ++i) rest += a[i] * b[i];
    return (four[0] + four[2]) + (four[1] + four[3]) + rest;
}

// ---------------------------------------------------------------------------------------------------------------------
// Tensors and the tape. Templated on the scalar: float trains, double serves the checks against finite differences.
//
// Reverse-mode differentiation. Each operation computes its result at once and records a step that turns
// dy = d(loss)/d(result) into its share of dx = d(loss)/d(x) for each input x: dx += (dy/dx)^T dy. backward() runs the
// steps from the last operation to the first, so that dy is complete before it is passed on.

template <class T>
struct Tape;

// Memory that is handed out in pieces and taken back all at once; after the first batch of a shape nothing is
// allocated.
class Arena {
  public:
    // `bytes` bytes aligned to 64, not initialised, valid until reset().
    void* take(size_t bytes) {
        bytes = (bytes + 63) / 64 * 64;
        while (chunk_ < chunks_.size() && used_ + bytes > chunks_[chunk_].bytes) {
            ++chunk_;
            used_ = 0;
        }
        if (chunk_ == chunks_.size()) add_chunk(std::max({bytes, total_, size_t{1} << 20}));
        used_ += bytes;
        return chunks_[chunk_].lines.get() + (used_ - bytes) / sizeof(Buffer::Line);
    }
    // Takes all pieces back. Several chunks become one, or batches of ever new shapes would each leave theirs behind.
    void reset() {
        chunk_ = used_ = 0;
        if (chunks_.size() < 2) return;
        chunks_.clear();
        add_chunk(std::exchange(total_, 0));
    }

  private:
    struct Chunk {
        std::unique_ptr<Buffer::Line[]> lines;
        size_t bytes;
    };
    // Each chunk doubles the memory; `new` without parentheses leaves it uninitialised, and unused pages cost nothing.
    void add_chunk(size_t bytes) {
        total_ += bytes;
        chunks_.push_back({std::unique_ptr<Buffer::Line[]>(new Buffer::Line[bytes / sizeof(Buffer::Line)]), bytes});
    }
    std::vector<Chunk> chunks_;
    size_t chunk_ = 0, used_ = 0, total_ = 0;
};

// d(loss)/d(a tensor), accumulated. Its memory is taken at the first addition, which overwrites it and so saves a pass
// of zeros, and given back after the last backward step that reads it: at any time few gradients are alive.
template <class T>
struct Gradient {
    T* data = nullptr;        // [rows, columns]; null before the first addition
    Tape<T>* tape = nullptr;  // that gives the memory; null: a parameter's gradient, which always has its own
    int readers = 0;          // backward steps still to come
};

// Two-dimensional, row-major. `gradient` is null where no gradient is wanted (inputs, acting).
template <class T>
struct Tensor {
    T* value = nullptr;  // [rows, columns]
    Gradient<T>* gradient = nullptr;
    int rows = 0, columns = 0;
    size_t size() const { return static_cast<size_t>(rows) * static_cast<size_t>(columns); }
    T* grad() const { return gradient->data; }  // [rows, columns] d(loss)/d(value) so far
};

// Records each operation's backward step and replays them in reverse. Gradients add up, so a tensor may be used any
// number of times. How it is used, once for each part of a batch:
//
//     tape.reset();                                    forgets the tensors of the part before
//     x = tape.constant(...);  y = linear(tape, x, affine);  loss = ...;
//     tape.backward(loss);                             adds to the gradients of the parameters in `affine`, ...
//
// A tensor of the tape lasts until reset(); parameters and their gradients belong to the model and last.
template <class T>
struct Tape {
    Compute& compute;
    bool recording = true;  // false: acting; no gradients, no dropout
    size_t part = 0;        // the number of this part of a batch: each part has its own dropout masks
    Random dropout_random{0, Stream::dropout};
    uint64_t dropout_step = 0;  // the update: fresh masks for each
    // Called with each layer's output as soon as it is computed; may be empty. While it is set, gradients stay until
    // reset(), for the caller to read.
    std::function<void(const std::string& name, const Tensor<T>& output)> watch;

    explicit Tape(Compute& c) : compute(c) {}

    // A result [rows, columns], not initialised.
    Tensor<T> make(int rows, int columns) {
        Tensor<T> x = {nullptr, nullptr, rows, columns};
        x.value = scratch<T>(x.size());
        if (recording) x.gradient = new (scratch<Gradient<T>>(1)) Gradient<T>{nullptr, this};
        return x;
    }

    // Shows a layer's output to watch(), and returns it.
    Tensor<T> show(const std::string& name, Tensor<T> output) const {
        if (watch) watch(name, output);
        return output;
    }

    // An input: copied, without gradient.
    template <class Number>
    Tensor<T> constant(const Number* data, int rows, int columns) {
        Tensor<T> x = {scratch<T>(static_cast<size_t>(rows) * columns), nullptr, rows, columns};
        std::copy_n(data, x.size(), x.value);
        return x;
    }

    // An array that lasts until reset(), for backward steps to read.
    template <class Element>
    const Element* keep(const std::vector<Element>& x) {
        Element* copy = scratch<Element>(x.size());
        std::copy(x.begin(), x.end(), copy);
        return copy;
    }

    // [count] elements, not initialised, valid until reset().
    template <class Element>
    Element* scratch(size_t count) {
        return static_cast<Element*>(arena_.take(count * sizeof(Element)));
    }

    // Keeps `step` for backward(), which runs it if anything has been added to the gradient of its result; without a
    // result (an empty tensor) it always runs. It is copied into the arena, so it may hold views and numbers only.
    template <class Step>
    void on_backward(Tensor<T> result, Step step) {
        static_assert(std::is_trivially_destructible_v<Step>);
        if (!recording) return;
        if (result.gradient) result.gradient->readers += 1;
        const auto call = [](void* s) { (*static_cast<Step*>(s))(); };
        steps_.push_back({call, new (arena_.take(sizeof(Step))) Step(step), result});
    }

    // d(loss)/d(everything recorded), for a loss [1, 1].
    void backward(Tensor<T> loss) {
        *gradient_of(loss) = 1;
        for (size_t i = steps_.size(); i-- > 0;) {
            Gradient<T>* const gradient = steps_[i].result.gradient;
            if (!gradient || gradient->data) steps_[i].call(steps_[i].step);
            if (gradient && --gradient->readers == 0 && gradient->data && !watch)
                unused_.emplace_back(steps_[i].result.size(), std::exchange(gradient->data, nullptr));
        }
    }

    // Memory for a gradient of `size` elements, not initialised: one that is no longer read, or new.
    T* gradient_memory(size_t size) {
        const auto fits = [=](const auto& unused) { return unused.first == size; };
        const auto found = std::find_if(unused_.rbegin(), unused_.rend(), fits);  // the latest is still in the cache
        if (found == unused_.rend()) return scratch<T>(size);
        T* const memory = found->second;
        unused_.erase(std::next(found).base());
        return memory;
    }

    // Forgets all tensors made so far.
    void reset() {
        steps_.clear();
        unused_.clear();
        arena_.reset();
    }

  private:
    struct Step {
        void (*call)(void*);
        void* step;
        Tensor<T> result;
    };
    Arena arena_;
    std::vector<Step> steps_;
    std::vector<std::pair<size_t, T*>> unused_;  // gradients that no step reads any more, with their sizes
};

// How the caller must store its contribution to x's gradient: the first one overwrites all of it. To be called once per
// contribution, by the thread that runs backward().
template <class T>
Store next_store(Tensor<T> x) {
    if (x.grad()) return Store::accumulate;
    x.gradient->data = x.gradient->tape->gradient_memory(x.size());
    return Store::overwrite;
}

// x's gradient, to be added to: zeros before the first contribution.
template <class T>
T* gradient_of(Tensor<T> x) {
    if (next_store(x) == Store::overwrite) std::fill_n(x.grad(), x.size(), T(0));
    return x.grad();
}

// Shares rows [0, rows) out in blocks; f(begin, end, worker) must treat each row alone. `work`: about how many
// operations a row. Little work in all is done by the calling thread.
template <class F>
void for_rows(Compute& compute, int rows, int work, F&& f) {
    const bool serial = static_cast<double>(rows) * work < 2e4;
    const int pieces = serial ? 1 : std::max(8, compute.threads.count());
    const int block = std::max(1, std::min(divide_up(rows, pieces), 1 + 100000 / std::max(1, work)));
    const auto share = [&](int task, int worker) { f(task * block, std::min(rows, (task + 1) * block), worker); };
    compute.threads.run(divide_up(rows, block), share, serial);
}

// to[j] += sum over rows of from[row, j], rows `stride` apart: each column alone, in order of rows.
template <class T>
void add_column_sums(Compute& compute, T* to, const T* from, int rows, int columns, ptrdiff_t stride) {
    constexpr int group = 64;  // columns
    for_rows(compute, divide_up(columns, group), rows * group, [=](int begin, int end, int) {
        for (int row = 0; row < rows; ++row)
            for (int j = begin * group; j < std::min(columns, end * group); ++j) to[j] += from[row * stride + j];
    });
}

// f(row, sums) adds a row's share to the column sums [columns] of its block of rows_a_sum rows. Returns the sums of all
// blocks, [blocks, columns], for add_column_sums; they last until the next call.
constexpr int rows_a_sum = 64;
template <class T, class F>
const T* block_sums(Compute& compute, int rows, int columns, const F& f) {
    const int blocks = divide_up(rows, rows_a_sum);
    T* const sums = reinterpret_cast<T*>(compute.sums.room(sizeof(T) * blocks * columns));
    for_rows(compute, blocks, 8 * rows_a_sum * columns, [&](int begin, int end, int) {
        vectorised<T>([&](auto lanes) INLINE_LAMBDA {
            for (int block = begin; block < end; ++block) {
                T* const sum = sums + static_cast<ptrdiff_t>(block) * columns;
                std::fill_n(sum, columns, T(0));
                const int end_row = std::min(rows, (block + 1) * rows_a_sum);
                for (int row = block * rows_a_sum; row < end_row; ++row) f(lanes, row, sum);
            }
        });
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

enum class Activation { none, relu };

// activation(x W + b) of x [n, in], output columns [first, first + count) alone: y [n, count]. W [in, out] is
// affine.weight, or its transpose if the layout is out_in.
//
// Backward, from dy [n, count], where y = relu(z) first becomes dz = dy where y > 0, else 0:
//     dx += dz W^T        dW += x^T dz        db += sum of dz over rows
template <class T>
Tensor<T> linear(Tape<T>& tape, Tensor<T> x, const Affine<T>& affine, int first, int count,
                 Activation activation = Activation::none) {
    const Tensor<T> w = affine.weight, y = tape.make(x.rows, count);
    const bool transposed = affine.layout == Layout::out_in, relu = activation == Activation::relu;
    const ptrdiff_t offset = transposed ? static_cast<ptrdiff_t>(first) * w.columns : first;
    Compute& compute = tape.compute;
    matmul(compute, View<T>{y.value, count}, {x.value, x.columns}, {w.value + offset, w.columns, transposed, true},
           x.rows, count, x.columns, Store::overwrite, {affine.bias.value + first, relu});
    const Tensor<T> bias = affine.bias;
    tape.on_backward(y, [=, &compute] {
        T *const d_out = y.grad(), *const dw = w.grad() + offset, *const db = bias.grad() + first;
        // db += sum over rows of dy, which becomes the gradient before the activation on the way.
        const T* sums = block_sums<T>(compute, y.rows, count, [=](auto, ptrdiff_t row, T* sum) INLINE_LAMBDA {
            T* const dy = d_out + row * count;
            const T* const out = y.value + row * count;
            if (relu)
                for (int j = 0; j < count; ++j) dy[j] = out[j] > 0 ? dy[j] : T(0);
            for (int j = 0; j < count; ++j) sum[j] += dy[j];
        });
        add_column_sums(compute, db, sums, divide_up(y.rows, rows_a_sum), count, count);
        const View<const T> dy = {d_out, count}, in = {x.value, x.columns};
        if (x.gradient) {  // dx += dy W^T
            const Store store = next_store(x);
            matmul(compute, View<T>{x.grad(), x.columns}, dy, {w.value + offset, w.columns, !transposed, true}, x.rows,
                   x.columns, count, store);
        }
        // dW += x^T dy, or dW^T += dy^T x; here a stride is the number of columns
        const auto [left, right] = transposed ? std::pair(dy, in) : std::pair(in, dy);
        matmul(compute, View<T>{dw, w.columns}, {left.data, left.stride, true}, right, left.stride, right.stride,
               x.rows, Store::accumulate);
    });
    return y;
}

template <class T>
Tensor<T> linear(Tape<T>& tape, Tensor<T> x, const Affine<T>& affine, Activation activation = Activation::none) {
    return linear(tape, x, affine, 0, affine.bias.columns, activation);
}

// to[to_rows[i]] += from[from_rows[i]] for i < count, in this order, rows of d numbers; a null list: rows 0, 1, ...
// Shared out by columns, since a row may be added to twice. With Store::overwrite the rows of `to` must all be
// different; they are set, and need not have been initialised.
template <class T>
void add_rows(Compute& compute, T* to, const int* to_rows, const T* from, const int* from_rows, int count, int d,
              Store store) {
    constexpr int group = 64;  // columns
    for_rows(compute, divide_up(d, group), count * group, [=](int begin, int end, int) {
        vectorised<T>([=](auto) INLINE_LAMBDA {
            for (ptrdiff_t i = 0; i < count; ++i) {
                T* const sum = to + (to_rows ? to_rows[i] : i) * d;
                const T* const row = from + (from_rows ? from_rows[i] : i) * d;
                for (int j = begin * group; j < std::min(d, end * group); ++j)
                    sum[j] = (store == Store::overwrite ? T(0) : sum[j]) + row[j];
            }
        });
    });
}

// add_rows of tensors [n, d]. Backward: from's gradient at from_rows[i] += to's gradient at to_rows[i].
template <class T>
void add_rows_by_index(Tape<T>& tape, Tensor<T> to, const int* to_rows, Tensor<T> from, const int* from_rows, int count,
                       Store store = Store::accumulate) {
    Compute& compute = tape.compute;
    add_rows<T>(compute, to.value, to_rows, from.value, from_rows, count, to.columns, store);
    tape.on_backward(to, [=, &compute] {
        const bool every_row = !from_rows && count == from.rows;  // each is added to once, so it needs no zeros first
        const Store store_from = every_row ? next_store(from) : Store::accumulate;
        T* const d_from = every_row ? from.grad() : gradient_of(from);
        add_rows<T>(compute, d_from, from_rows, to.grad(), to_rows, count, to.columns, store_from);
    });
}

// The named rows of x [n, d]: [count, d].
template <class T>
Tensor<T> select_rows(Tape<T>& tape, Tensor<T> x, const int* rows, int count) {
    const Tensor<T> y = tape.make(count, x.columns);
    add_rows_by_index(tape, y, nullptr, x, rows, count, Store::overwrite);
    return y;
}

template <class T>
struct Norm {
    Tensor<T> weight, bias;  // [1, d]
};

// LayerNorm over the columns of x [n, d]: y = (x - mean) / sqrt(variance + 1e-5) * weight + bias, variance with 1/d.
//
// Backward, for each row: with n = (x - mean) * scale, scale = 1 / sqrt(variance + 1e-5), and g = dy * weight,
//     dx = (g - mean(g) - n * mean(g * n)) * scale      the mean and the variance depend on x, too
//     d_weight += dy * n        d_bias += dy            summed over rows
template <class T>
Tensor<T> layer_norm(Tape<T>& tape, Tensor<T> x, const Norm<T>& norm) {
    const int d = x.columns;
    const Tensor<T> y = tape.make(x.rows, d), weight = norm.weight, bias = norm.bias;
    T* means = tape.template scratch<T>(x.rows);   // [n]
    T* scales = tape.template scratch<T>(x.rows);  // [n] 1 / sqrt(variance + 1e-5)
    T* ones = tape.template scratch<T>(d);         // [d]: a sum is a dot product with ones
    std::fill_n(ones, d, T(1));
    Compute& compute = tape.compute;
    for_rows(compute, x.rows, 8 * d, [=](int begin, int end, int) {
        vectorised<T>([=](auto lanes) INLINE_LAMBDA {
            for (ptrdiff_t row = begin; row < end; ++row) {
                const T* in = x.value + row * d;
                T* out = y.value + row * d;
                const T mean = dot<lanes>(in, ones, d) / T(d);
                for (int j = 0; j < d; ++j) out[j] = in[j] - mean;
                const T scale = T(1) / std::sqrt(dot<lanes>(out, out, d) / T(d) + T(1e-5));
                for (int j = 0; j < d; ++j) out[j] = out[j] * scale * weight.value[j] + bias.value[j];
                means[row] = mean;
                scales[row] = scale;
            }
        });
    });
    tape.on_backward(y, [=, &compute] {
        const bool set = next_store(x) == Store::overwrite;
        const T* const d_out = y.grad();
        T* const d_in = x.grad();
        // A block's sums [4, d]: d_weight, d_bias, and room for a row's g and n beside them in the cache.
        const T* sums = block_sums<T>(compute, x.rows, 4 * d, [=](auto lanes, ptrdiff_t row, T* sum) INLINE_LAMBDA {
            const T *in = x.value + row * d, *dy = d_out + row * d;
            T *dx = d_in + row * d, *g = sum + 2 * d, *n = sum + 3 * d;
            const T mean = means[row], scale = scales[row];
#pragma GCC ivdep  // too many arrays for the compiler to check: x, dy, the weight and the sums do not overlap
            for (int j = 0; j < d; ++j) {
                n[j] = (in[j] - mean) * scale;
                g[j] = dy[j] * weight.value[j];
                sum[j] += dy[j] * n[j];
                sum[d + j] += dy[j];
            }
            const T mean_g = dot<lanes>(g, ones, d) / T(d), mean_gn = dot<lanes>(g, n, d) / T(d);
            for (int j = 0; j < d; ++j) dx[j] = (set ? T(0) : dx[j]) + (g[j] - mean_g - n[j] * mean_gn) * scale;
        });
        add_column_sums(compute, weight.grad(), sums, divide_up(x.rows, rows_a_sum), d, 4 * d);
        add_column_sums(compute, bias.grad(), sums + d, divide_up(x.rows, rows_a_sum), d, 4 * d);
    });
    return y;
}

// Inverted dropout of the elements of one place in the network: each is multiplied by 0 with probability p, by
// 1 / (1 - p) else. Which are kept comes from the counter (update, place, element).
struct Dropout {
    Random random;
    uint64_t step;
    uint32_t site;
    float probability;

    // kept [n] of the elements [first, first + n): 1, or 0 where one is dropped. Element e has word e % 4 of counter
    // e / 4.
    ALWAYS_INLINE void fill(uint8_t* kept, size_t first, size_t n) const {
        if (probability == 0) {
            std::fill_n(kept, n, uint8_t{1});
            return;
        }
        const uint32_t threshold = static_cast<uint32_t>(static_cast<double>(probability) * 0x1p32);
        constexpr size_t counters = 32;
        for (size_t i = 0; i < n;) {
            uint32_t words[4 * counters];
            random.many_words<counters>(words, step, static_cast<uint32_t>((first + i) / 4), site);
            const size_t skip = (first + i) % 4, count = std::min(4 * counters - skip, n - i);
            for (size_t j = 0; j < count; ++j) kept[i + j] = words[skip + j] >= threshold;
            i += count;
        }
    }
};

// The factors of some elements, a byte each: a quarter of the memory traffic of floats.
template <class T>
struct DropoutMask {
    const uint8_t* kept;  // [elements] 1 or 0
    T scale;              // 1 / (1 - p)
    ALWAYS_INLINE T factor(ptrdiff_t i) const { return T(kept[i]) * scale; }
};

// `probability` counts while the tape records; without recording nothing is dropped.
template <class T>
Dropout dropout_at(const Tape<T>& tape, uint32_t site, float probability) {
    const uint32_t own_site = site + static_cast<uint32_t>(tape.part << 20);
    return {tape.dropout_random, tape.dropout_step, own_site, tape.recording ? probability : 0.0f};
}

// The mask of [rows, columns] elements; it lasts until the tape is reset.
template <class T>
DropoutMask<T> dropout_mask(Tape<T>& tape, const Dropout& dropout, int rows, ptrdiff_t columns) {
    uint8_t* const kept = tape.template scratch<uint8_t>(rows * columns);
    for_rows(tape.compute, rows, static_cast<int>(8 * columns), [=](int begin, int end, int) {
        vectorised<float>([=](auto) INLINE_LAMBDA {
            dropout.fill(kept + begin * columns, begin * columns, (end - begin) * columns);
        });
    });
    return {kept, T(1) / (T(1) - T(dropout.probability))};
}

// dropout(x) + residual, [n, d]; without the sum if the residual is empty.
template <class T>
Tensor<T> dropout_add(Tape<T>& tape, Tensor<T> x, const Dropout& dropout, Tensor<T> residual = {}) {
    if (dropout.probability == 0 && !residual.value) return x;
    const Tensor<T> y = tape.make(x.rows, x.columns);
    const ptrdiff_t d = x.columns;
    const DropoutMask<T> mask = dropout_mask(tape, dropout, x.rows, d);
    Compute& compute = tape.compute;
    for_rows(compute, x.rows, 4 * x.columns, [=](int begin, int end, int) {
        vectorised<T>([=](auto) INLINE_LAMBDA {
            for (ptrdiff_t i = begin * d; i < end * d; ++i) {
                const T dropped = x.value[i] * mask.factor(i);
                y.value[i] = residual.value ? dropped + residual.value[i] : dropped;
            }
        });
    });
    tape.on_backward(y, [=, &compute] {  // dx += dy * factor; d_residual += dy
        const bool set_x = next_store(x) == Store::overwrite;
        const bool set_residual = residual.gradient && next_store(residual) == Store::overwrite;
        const T* const dy = y.grad();
        T *const dx = x.grad(), *const d_residual = residual.gradient ? residual.grad() : nullptr;
        for_rows(compute, x.rows, 4 * x.columns, [=](int begin, int end, int) {
            vectorised<T>([=](auto) INLINE_LAMBDA {
                for (ptrdiff_t i = begin * d; i < end * d; ++i) dx[i] = (set_x ? T(0) : dx[i]) + dy[i] * mask.factor(i);
                if (d_residual)
                    for (ptrdiff_t i = begin * d; i < end * d; ++i)
                        d_residual[i] = (set_residual ? T(0) : d_residual[i]) + dy[i];
            });
        });
    });
    return y;
}

// to = or += sum_j weight_j row_j, for Width * Vectors columns, held in registers (where there are enough).
template <int Width, int Vectors, class T>
ALWAYS_INLINE void add_columns(T* to, const T* weight, ptrdiff_t weight_stride, const T* rows, ptrdiff_t stride, int n,
                               Store store) {
    Vector<T, Width> sum[Vectors] = {};
    if (store == Store::accumulate)
        for (int v = 0; v < Vectors; ++v) sum[v] = lanes_at<Width>(to + Width * v);
    for (int j = 0; j < n; ++j)
        for (int v = 0; v < Vectors; ++v)
            sum[v] += weight[j * weight_stride] * lanes_at<Width>(rows + j * stride + Width * v);
    for (int v = 0; v < Vectors; ++v) lanes_at<Width>(to + Width * v) = sum[v];
}

// to [size] = or += sum_j weight_j row_j for rows [n, size], weights `weight_stride` apart.
template <int Width, class T>
ALWAYS_INLINE void add_weighted_rows(T* __restrict to, const T* weight, ptrdiff_t weight_stride,
                                     const T* __restrict rows, int n, int size, Store store) {
    int c = 0;
    for (; c + 8 * Width <= size; c += 8 * Width)
        add_columns<Width, 8>(to + c, weight, weight_stride, rows + c, size, n, store);
    for (; c + 16 <= size; c += 16) add_columns<8, 2>(to + c, weight, weight_stride, rows + c, size, n, store);
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

// softmax of x [n], in place: the largest is subtracted from each x first, so that no exponential overflows.
template <class T>
void softmax(T* x, int n) {
    const T largest = *std::max_element(x, x + n);
    T total = 0;
    for (int i = 0; i < n; ++i) {
        x[i] = std::exp(x[i] - largest);
        total += x[i];
    }
    for (int i = 0; i < n; ++i) x[i] /= total;
}

// One sequence of a packed batch: where its tokens lie, and which rows are its queries.
struct Span {
    int first_token, tokens;   // the sequence's rows of k and v
    int first_query, queries;  // its rows of q
};

// What attention's two passes work on, one (sequence, head) at a time; tasks share nothing that they write, because a
// span's rows of out, d_q, d_k and d_v belong to one task. With queries q_i, keys k_j, values v_j of one head, m_ij its
// dropout factors and j running over the tokens up to i's:
//
//     s_ij = q_i . k_j / sqrt(size)        w_i = softmax(s_i)        out_i = sum_j m_ij w_ij v_j
//
// and backward, from d_out_i:
//
//     d_v_j = sum_i m_ij w_ij d_out_i      d_w_ij = m_ij v_j . d_out_i      d_s_ij = w_ij (d_w_ij - sum_m w_im d_w_im)
//     d_q_i = sum_j d_s_ij k_j / sqrt(size)                                 d_k_j = sum_i d_s_ij q_i / sqrt(size)
template <class T>
struct AttentionPass {
    Tensor<T> q, kv, out;
    const int* position;  // [queries] the token of each query
    int d, size, heads;   // width of all heads and of one
    int longest;          // sequence of the batch, in tokens
    // [queries, heads, longest]: w_ij of the forward pass, and room for the backward pass, which turns them into
    // m_ij w_ij and d_s_ij / sqrt(size).
    T *weights, *d_weights;
    DropoutMask<T> mask;  // [queries, heads, longest]
    T scale;              // 1 / sqrt(size)

    // How many tokens query i sees: its own sequence up to and with itself.
    int seen_by(ptrdiff_t i, const Span& span) const { return position[i] - span.first_token + 1; }
    ptrdiff_t head_at(ptrdiff_t i, ptrdiff_t h) const { return (i * heads + h) * longest; }

    // rows [longest, size], room [longest]: scratch memory.
    template <int Width>
    ALWAYS_INLINE void forward(const Span& span, ptrdiff_t h, T* rows, T* room) const {
        const ptrdiff_t end = span.first_query + span.queries, stride = kv.columns;
        const T* const keys = kv.value + span.first_token * stride + (stride - 2 * d) + h * size;
        gather_rows(rows, keys, stride, span.tokens, size);
        for (ptrdiff_t i = span.first_query; i < end; ++i) {
            T* const w = weights + head_at(i, h);
            const T* const query = q.value + i * q.columns + h * size;
            for (int j = 0; j < seen_by(i, span); ++j) w[j] = dot<Width>(query, rows + j * size, size) * scale;
            softmax(w, seen_by(i, span));
        }
        gather_rows(rows, keys + d, stride, span.tokens, size);  // values
        for (ptrdiff_t i = span.first_query; i < end; ++i) {
            const int seen = seen_by(i, span);
            for (int j = 0; j < seen; ++j) room[j] = mask.factor(head_at(i, h) + j) * weights[head_at(i, h) + j];
            add_weighted_rows<Width>(out.value + i * d + h * size, room, 1, rows, seen, size, Store::overwrite);
        }
    }

    template <int Width>
    ALWAYS_INLINE void backward(const Span& span, ptrdiff_t h, T* rows, Store to_q, Store to_kv) const {
        const ptrdiff_t first = span.first_query, end = first + span.queries, stride = kv.columns, column = h * size;
        const ptrdiff_t first_key = span.first_token * stride + (stride - 2 * d) + column;
        gather_rows(rows, kv.value + first_key + d, stride, span.tokens, size);  // values
        for (ptrdiff_t i = first; i < end; ++i) {
            const int seen = seen_by(i, span);
            T *w = weights + head_at(i, h), *dw = d_weights + head_at(i, h);
            const DropoutMask<T> of_head = {mask.kept + head_at(i, h), mask.scale};
            // dw becomes d_s / sqrt(size), w the weights after dropout: what the sums below need.
            const T* const d_out = out.grad() + i * d + column;
            for (int j = 0; j < seen; ++j) dw[j] = dot<Width>(d_out, rows + j * size, size) * of_head.factor(j);
            const T mean = dot<Width>(w, dw, seen);
            for (int j = 0; j < seen; ++j) dw[j] = w[j] * (dw[j] - mean) * scale;
            for (int j = 0; j < seen; ++j) w[j] *= of_head.factor(j);
        }
        // d_q_i: a sum over the keys that i sees.
        gather_rows(rows, kv.value + first_key, stride, span.tokens, size);
        for (ptrdiff_t i = first; i < end; ++i)
            add_weighted_rows<Width>(q.grad() + i * q.columns + column, d_weights + head_at(i, h), 1, rows,
                                     seen_by(i, span), size, to_q);
        // d_k_j and d_v_j: sums over the queries that see j.
        gather_rows(rows, q.value + first * q.columns + column, q.columns, span.queries, size);
        add_to_keys<Width>(kv.grad() + first_key, d_weights, span, h, rows, to_kv);
        gather_rows(rows, out.grad() + first * d + column, d, span.queries, size);
        add_to_keys<Width>(kv.grad() + first_key + d, weights, span, h, rows, to_kv);
    }

    // d_key_j = or += sum over the queries i that see j of weight_ij row_i; rows [span.queries, size].
    template <int Width>
    ALWAYS_INLINE void add_to_keys(T* d_key, const T* weight, const Span& span, ptrdiff_t h, const T* rows,
                                   Store store) const {
        const ptrdiff_t first = span.first_query, end = first + span.queries;
        ptrdiff_t i = first;
        for (ptrdiff_t j = 0; j < span.tokens; ++j) {
            while (i < end && seen_by(i, span) <= j) ++i;
            add_weighted_rows<Width>(d_key + j * kv.columns, weight + head_at(i, h) + j, ptrdiff_t{heads} * longest,
                                     rows + (i - first) * size, static_cast<int>(end - i), size, store);
        }
    }
};

// Calls f(lanes, span, head, rows, room) for every head of every span, with scratch memory for `longest` rows of a head
// and for `longest` numbers. `work`: about how many operations a span.
template <class T, class F>
void for_heads(Compute& compute, const AttentionPass<T>& pass, const Span* spans, int span_count, int work,
               const F& f) {
    const size_t bytes = static_cast<size_t>(pass.longest) * static_cast<size_t>(pass.size + 1) * sizeof(T);
    compute.reserve_scratch(bytes);
    for_rows(compute, span_count, work, [&](int begin, int end, int worker) {
        T* const rows = reinterpret_cast<T*>(compute.scratch[worker].room(bytes));
        vectorised<T>([&](auto lanes) INLINE_LAMBDA {
            for (int s = begin; s < end; ++s)
                for (int h = 0; h < pass.heads; ++h) f(lanes, spans[s], h, rows, rows + pass.longest * pass.size);
        });
    });
}

// Causal attention with `heads` heads, dropout on the weights, on packed sequences. Positions ascend within a span.
// q [queries, d] and kv [tokens, 2 d], keys, then values; or both are one tensor [tokens, 3 d]: queries, keys, values.
// Head h has columns h d/heads onwards of each. Every row lies in one span. Query i stands at token position[i] of the
// whole batch and sees its own sequence up to and with itself. Returns [queries, d].
template <class T>
Tensor<T> attention(Tape<T>& tape, Tensor<T> q, Tensor<T> kv, int d, const Span* spans, int span_count,
                    const int* position, int heads, const Dropout& dropout) {
    const int size = d / heads;
    const Tensor<T> out = tape.make(q.rows, d);
    int longest = 1;
    for (int s = 0; s < span_count; ++s) longest = std::max(longest, spans[s].tokens);
    const ptrdiff_t query_size = static_cast<ptrdiff_t>(heads) * longest;
    const size_t all = static_cast<size_t>(q.rows * query_size);
    T* const weights = tape.template scratch<T>(all);
    T* const d_weights = tape.recording ? tape.template scratch<T>(all) : nullptr;
    const DropoutMask<T> mask = dropout_mask(tape, dropout, q.rows, query_size);
    Compute& compute = tape.compute;
    const AttentionPass<T> pass = {q,     kv,      out,     position,  d,    size,
                                   heads, longest, weights, d_weights, mask, T(1) / std::sqrt(T(size))};
    const int work = static_cast<int>(std::min(1e9, 4.0 * longest * d * std::max(1, q.rows / std::max(1, span_count))));
    for_heads(compute, pass, spans, span_count, work,
              [&](auto lanes, const Span& span, int h, T* rows, T* room)
                  INLINE_LAMBDA { pass.template forward<lanes>(span, h, rows, room); });
    tape.on_backward(out, [=, &compute] {
        const Store to_q = next_store(q), to_kv = q.value == kv.value ? to_q : next_store(kv);
        for_heads(compute, pass, spans, span_count, 2 * work,
                  [&](auto lanes, const Span& span, int h, T* rows, T*)
                      INLINE_LAMBDA { pass.template backward<lanes>(span, h, rows, to_q, to_kv); });
    });
    return out;
}

// ---------------------------------------------------------------------------------------------------------------------
// Parameters by name, and how each kind starts: the distributions of ODT's code, where GPT-2's are those of the
// transformers library, a Linear's those of PyTorch, and the policy's output layers are orthogonal.

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
    std::vector<T> gradient;          // accumulated until an update takes it
    Gradient<T> gradient_place = {};  // for tensor(), which must not outlive a move of this parameter
    Tensor<T> tensor() {
        gradient_place.data = gradient.data();
        return {value.data(), &gradient_place, rows(), static_cast<int>(shape.back())};
    }
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

// The start values of a tensor. fan_in: inputs of its layer, for uniform_fan_in alone. number: of the tensor, in the
// order of construction. From Stream::initialisation (step: number, index: element).
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
// last action of a window is never a token, and in the last layer only the state tokens whose prediction is wanted (the
// queries) go on after attention.

// The kinds of policy:
//   squashed_gaussian   a = tanh(u), u ~ N(mean, exp(log_std)^2) in each dimension     ODT, WODTEM; continuous actions
//   categorical         a move m with log-probability log_p[m]                         all methods; discrete actions
//   deterministic       a = tanh(output)                                               DT; continuous actions
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
    void resize(size_t n, size_t state_dim, size_t action_dim) {
        returns_to_go.resize(n);
        states.resize(n * state_dim);
        actions.resize(n * action_dim);
        timesteps.resize(n);
    }
};

enum class Queries { every_state, last_state };  // training learns from every step of a window; acting wants the last

// The distribution of the next action at each of the queries.
template <class T>
struct Policy {
    Head head;
    Tensor<T> output;   // [queries, action_dim] the Gaussian's mean; log-probabilities; or the action itself
    Tensor<T> log_std;  // [queries, action_dim] in [-5, 2]; squashed Gaussian only
};

// The parameters in the order of their construction, d the width, S and A state_dim and action_dim. Each layer has a
// weight and a bias [out]; biases start at 0, but for the uniform ones.
//
//     name                          weight                 start of the weight
//     embed_return                  [d, 1]                 uniform in +-1/sqrt(fan in), as its bias
//     embed_state                   [d, S]                 the same
//     embed_action                  [d, A]                 the same
//     embed_ln                      [d]                    1
//     transformer.h.L.ln_1          [d]                    1                                   layer L = 0, 1, ...
//     transformer.h.L.attn.c_attn   [d, 3 d]               N(0, 0.02^2)
//     transformer.h.L.attn.c_proj   [d, d]                 N(0, 0.02^2)
//     transformer.h.L.ln_2          [d]                    1
//     transformer.h.L.mlp.c_fc      [d, 4 d]               N(0, 0.02^2)
//     transformer.h.L.mlp.c_proj    [4 d, d]               N(0, 0.02^2)
//     transformer.ln_f              [d]                    1
//     predict_action.mu             [A, d]                 orthogonal rows                     squashed Gaussian
//     predict_action.log_std        [A, d]                 orthogonal rows                     squashed Gaussian
//     predict_action.logits         [A, d]                 orthogonal rows                     categorical
//     predict_action.0              [A, d]                 as embed_return                      deterministic
//     embed_ordering                [max_timesteps, d]     N(0, 1); no bias                    with positions only
template <class T>
struct Transformer {
    struct Block {
        Norm<T> ln_1;
        Affine<T> c_attn, attn_proj;  // c_attn: columns q, k, v in this order
        Norm<T> ln_2;
        Affine<T> c_fc, mlp_proj;
    };
    TransformerConfig config;
    std::vector<Parameter<T>> parameters;  // in the order of construction
    Affine<T> embed_return, embed_state, embed_action;
    Tensor<T> embed_ordering;  // [max_timesteps, width]
    Norm<T> embed_ln;
    std::vector<Block> blocks;
    Norm<T> ln_f;
    Affine<T> predict_mean, predict_log_std;

    // A network with fresh parameters. Errors: nn.config for sizes that do not fit together.
    Transformer(const TransformerConfig& c, uint32_t seed) : config(c) {
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
        parameters.reserve(20 + 12 * static_cast<size_t>(c.layers));  // tensors point to them
        embed_return = affine("embed_return", 1, d, Init::uniform_fan_in, seed);
        embed_state = affine("embed_state", c.state_dim, d, Init::uniform_fan_in, seed);
        embed_action = affine("embed_action", c.action_dim, d, Init::uniform_fan_in, seed);
        embed_ln = norm("embed_ln", seed);
        for (int layer = 0; layer < c.layers; ++layer) {
            const std::string h = "transformer.h." + std::to_string(layer) + ".";
            Block& block = blocks.emplace_back();
            block.ln_1 = norm(h + "ln_1", seed);
            block.c_attn = affine(h + "attn.c_attn", d, 3 * d, Init::normal_002, seed);
            block.attn_proj = affine(h + "attn.c_proj", d, d, Init::normal_002, seed);
            block.ln_2 = norm(h + "ln_2", seed);
            block.c_fc = affine(h + "mlp.c_fc", d, 4 * d, Init::normal_002, seed);
            block.mlp_proj = affine(h + "mlp.c_proj", 4 * d, d, Init::normal_002, seed);
        }
        ln_f = norm("transformer.ln_f", seed);
        const bool gaussian = c.head == Head::squashed_gaussian, categorical = c.head == Head::categorical;
        const char* const output = gaussian      ? "predict_action.mu"
                                   : categorical ? "predict_action.logits"
                                                 : "predict_action.0";
        const Init start = c.head == Head::deterministic ? Init::uniform_fan_in : Init::orthogonal;
        predict_mean = affine(output, d, c.action_dim, start, seed);
        if (gaussian) predict_log_std = affine("predict_action.log_std", d, c.action_dim, start, seed);
        // Last, so that having it moves no other tensor's random numbers.
        if (c.max_timesteps > 0)
            embed_ordering = add("embed_ordering.weight", {c.max_timesteps, d}, Init::normal_1, 0, seed);
    }
    Transformer(const Transformer&) = delete;
    Transformer& operator=(const Transformer&) = delete;

  private:
    Tensor<T> add(const std::string& name, const std::vector<int>& shape, Init init, int fan_in, uint32_t seed) {
        const size_t size = static_cast<size_t>(shape.front()) * (shape.size() > 1 ? shape.back() : 1);
        parameters.push_back({name, {shape.begin(), shape.end()}, std::vector<T>(size), std::vector<T>(size)});
        initialise(parameters.back(), init, fan_in, seed, parameters.size() - 1);
        return parameters.back().tensor();
    }
    // The layout follows from where the layer stands: [in, out] inside the GPT-2 stack, whose weights are normal.
    Affine<T> affine(const std::string& name, int in, int out, Init init, uint32_t seed) {
        const bool in_stack = init == Init::normal_002, uniform = init == Init::uniform_fan_in;
        const std::vector<int> shape = in_stack ? std::vector{in, out} : std::vector{out, in};
        const Tensor<T> weight = add(name + ".weight", shape, init, in, seed);
        const Tensor<T> bias = add(name + ".bias", {out}, uniform ? init : Init::zeros, in, seed);
        return {weight, bias, in_stack ? Layout::in_out : Layout::out_in};
    }
    Norm<T> norm(const std::string& name, uint32_t seed) {
        const Tensor<T> weight = add(name + ".weight", {config.width}, Init::ones, 0, seed);
        return {weight, add(name + ".bias", {config.width}, Init::zeros, 0, seed)};
    }
};

// Where each token of a packed batch lies, and which tokens are queries. Windows of 2 steps and 1 step, say:
//
//     row       0    1    2    3    4     5    6
//     token     R_0  s_0  a_0  R_1  s_1   R_0  s_0      the last action of a window is no token
//     sees      0    0-1  0-2  0-3  0-4   5    5-6      its own window, up to and with itself
//     query          x              x          x        every_state; with last_state rows 4 and 6 alone
struct TokenLayout {
    int tokens = 0;
    std::vector<Span> all_spans, query_spans;   // one per window; its queries: all its tokens, or the layout's queries
    std::vector<int> all_tokens, query_tokens;  // token rows
    std::vector<int> step_token;                // [n] row of a step's R token; s and a follow
};

// The layout of a batch's windows, one after the other.
inline TokenLayout token_layout(const SequenceBatch& batch, Queries queries) {
    TokenLayout layout;
    for (const int length : batch.lengths) {
        const int tokens = 3 * length - 1, first_query = static_cast<int>(layout.query_tokens.size());
        for (int c = 0; c < length; ++c) {
            layout.step_token.push_back(layout.tokens + 3 * c);
            const bool is_query = queries == Queries::every_state || c == length - 1;
            if (is_query) layout.query_tokens.push_back(layout.tokens + 3 * c + 1);
        }
        const int end_query = static_cast<int>(layout.query_tokens.size());
        layout.all_spans.push_back({layout.tokens, tokens, layout.tokens, tokens});
        layout.query_spans.push_back({layout.tokens, tokens, first_query, end_query - first_query});
        for (int i = 0; i < tokens; ++i) layout.all_tokens.push_back(layout.tokens + i);
        layout.tokens += tokens;
    }
    return layout;
}

// Adds one kind of token: inputs [rows, layer's inputs] through the layer to the rows `at`, and to each the row of the
// position table that belongs to its time.
template <class T>
void place_tokens(Tape<T>& tape, Tensor<T> tokens, const Transformer<T>& model, const std::vector<int>& at,
                  const std::vector<int>& times, const std::vector<float>& inputs, const Affine<T>& layer) {
    const int count = static_cast<int>(at.size());
    if (count == 0) return;
    const int* const rows = tape.keep(at);
    const int columns = static_cast<int>(inputs.size()) / count;
    add_rows_by_index(tape, tokens, rows, linear(tape, tape.constant(inputs.data(), count, columns), layer), nullptr,
                      count);
    if (model.config.max_timesteps > 0)
        add_rows_by_index(tape, tokens, rows, model.embed_ordering, tape.keep(times), count);
}

// The tokens R, s, a of every step, each through its own linear layer, plus the position's row: [tokens, width].
template <class T>
Tensor<T> embed_tokens(Tape<T>& tape, const Transformer<T>& model, const SequenceBatch& batch,
                       const TokenLayout& layout) {
    const ptrdiff_t action_dim = model.config.action_dim;
    const Tensor<T> tokens = tape.make(layout.tokens, model.config.width);
    std::fill_n(tokens.value, tokens.size(), T(0));
    std::vector<int> state_token, action_token, times, action_times;  // rows of tokens, and the times of their steps
    std::vector<float> actions;                                       // those that are tokens: all but a window's last
    int step = 0;
    for (const int length : batch.lengths)
        for (int c = 0; c < length; ++c, ++step) {
            state_token.push_back(layout.step_token[step] + 1);
            // ODT clips at the table's end.
            times.push_back(std::min(batch.timesteps[step], model.config.max_timesteps - 1));
            if (c + 1 == length) continue;
            action_token.push_back(layout.step_token[step] + 2);
            action_times.push_back(times.back());
            const auto first = batch.actions.begin() + step * action_dim;
            actions.insert(actions.end(), first, first + action_dim);
        }
    place_tokens(tape, tokens, model, layout.step_token, times, batch.returns_to_go, model.embed_return);
    place_tokens(tape, tokens, model, state_token, times, batch.states, model.embed_state);
    place_tokens(tape, tokens, model, action_token, action_times, actions, model.embed_action);
    return tokens;
}

// Dropout's places in the network: 0 after the embedding's LayerNorm, then three a layer.
inline uint32_t dropout_site(int layer, int place) { return static_cast<uint32_t>(1 + 3 * layer + place); }

// One pre-LN block: x1 = x + attention(LN(x)), then x1 + MLP(LN(x1)). x [tokens, d] -> [queries, d]: `queries` are the
// token rows that go on after attention, and each span names its share of them.
template <class T>
Tensor<T> transformer_block(Tape<T>& tape, const Transformer<T>& model, int layer, Tensor<T> x,
                            const std::vector<Span>& spans, const std::vector<int>& queries) {
    const typename Transformer<T>::Block& block = model.blocks[layer];
    const int d = model.config.width, count = static_cast<int>(queries.size());
    const auto dropout = [&](int place) { return dropout_at(tape, dropout_site(layer, place), model.config.dropout); };
    const int* rows = tape.keep(queries);
    const Tensor<T> h = layer_norm(tape, x, block.ln_1);
    Tensor<T> q, kv;
    if (count == x.rows) {  // every token is a query: one tensor [tokens, 3 d]
        q = kv = linear(tape, h, block.c_attn);
    } else {
        q = linear(tape, select_rows(tape, h, rows, count), block.c_attn, 0, d);
        kv = linear(tape, h, block.c_attn, d, 2 * d);
        x = select_rows(tape, x, rows, count);
    }
    const Tensor<T> a = attention(tape, q, kv, d, tape.keep(spans), static_cast<int>(spans.size()), rows,
                                  model.config.heads, dropout(0));
    const std::string name = "transformer.h." + std::to_string(layer);
    const Tensor<T> x1 = tape.show(name + ".attn", dropout_add(tape, linear(tape, a, block.attn_proj), dropout(1), x));
    const Tensor<T> hidden = linear(tape, layer_norm(tape, x1, block.ln_2), block.c_fc, Activation::relu);
    return tape.show(name, dropout_add(tape, linear(tape, hidden, block.mlp_proj), dropout(2), x1));
}

// y = f(x) of each element; slope(x, y) is the derivative there.
template <class T, class F, class Slope>
Tensor<T> elementwise(Tape<T>& tape, Tensor<T> x, F f, Slope slope) {
    const Tensor<T> y = tape.make(x.rows, x.columns);
    for (size_t i = 0; i < x.size(); ++i) y.value[i] = f(x.value[i]);
    tape.on_backward(y, [=] {
        T* const dx = gradient_of(x);
        for (size_t i = 0; i < x.size(); ++i) dx[i] += slope(x.value[i], y.value[i]) * y.grad()[i];
    });
    return y;
}

// -5 + 3.5 (tanh(x) + 1): the log standard deviation, squashed into [-5, 2], of x [n, A]. Its slope is
// 3.5 (1 - tanh(x)^2). ODT's code.
template <class T>
Tensor<T> squash_log_std(Tape<T>& tape, Tensor<T> x) {
    const auto value = [](T u) { return T(-5) + T(3.5) * (std::tanh(u) + T(1)); };
    return elementwise(tape, x, value, [](T u, T) {
        const T t = std::tanh(u);
        return T(3.5) * (T(1) - t * t);
    });
}

// tanh(x) of x [n, A], by which the deterministic head keeps actions in (-1, 1); its slope is 1 - tanh(x)^2.
template <class T>
Tensor<T> tanh_of(Tape<T>& tape, Tensor<T> x) {
    return elementwise(
        tape, x, [](T u) { return std::tanh(u); }, [](T, T y) { return T(1) - y * y; });
}

// log of the softmax of each row of the logits, [n, actions]: y_j = x_j - log sum_m exp(x_m), with the largest x
// subtracted first. Backward: dx_j += dy_j - exp(y_j) sum_m dy_m.
template <class T>
Tensor<T> log_softmax(Tape<T>& tape, Tensor<T> logits) {
    const Tensor<T> y = tape.make(logits.rows, logits.columns);
    const ptrdiff_t actions = logits.columns;
    for (ptrdiff_t row = 0; row < logits.rows; ++row) {
        const T* x = logits.value + row * actions;
        const T largest = *std::max_element(x, x + actions);
        T total = 0;
        for (ptrdiff_t j = 0; j < actions; ++j) total += std::exp(x[j] - largest);
        for (ptrdiff_t j = 0; j < actions; ++j) y.value[row * actions + j] = x[j] - largest - std::log(total);
    }
    tape.on_backward(y, [=] {
        T* const dx = gradient_of(logits);
        for (ptrdiff_t row = 0; row < logits.rows; ++row) {
            const T *dy = y.grad() + row * actions, *log_p = y.value + row * actions;
            T total = 0;
            for (ptrdiff_t j = 0; j < actions; ++j) total += dy[j];
            for (ptrdiff_t j = 0; j < actions; ++j) dx[row * actions + j] += dy[j] - std::exp(log_p[j]) * total;
        }
    });
    return y;
}

// pi_theta(. | s_{-C,t}, g_{-C,t}) for every query of the batch, in order of windows and steps.
//
//     R, s, a of each step   -> a linear layer each, + the position's row        [tokens, d]
//     LayerNorm, dropout     -> blocks; in the last one only queries go on       [queries, d]
//     LayerNorm              -> the head                                         [queries, A]
template <class T>
Policy<T> forward(Tape<T>& tape, const Transformer<T>& model, const SequenceBatch& batch, Queries queries) {
    const TransformerConfig& config = model.config;
    const TokenLayout layout = token_layout(batch, queries);
    Tensor<T> x = tape.show("embed", embed_tokens(tape, model, batch, layout));
    x = dropout_add(tape, layer_norm(tape, x, model.embed_ln), dropout_at(tape, 0, config.dropout));
    tape.show("embed_ln", x);
    for (int layer = 0; layer < config.layers; ++layer) {
        const bool last = layer + 1 == config.layers;
        x = transformer_block(tape, model, layer, x, last ? layout.query_spans : layout.all_spans,
                              last ? layout.query_tokens : layout.all_tokens);
    }
    x = tape.show("transformer.ln_f", layer_norm(tape, x, model.ln_f));
    Policy<T> policy = {config.head, linear(tape, x, model.predict_mean), {}};
    if (config.head == Head::categorical) policy.output = log_softmax(tape, policy.output);
    if (config.head == Head::deterministic) policy.output = tanh_of(tape, policy.output);
    tape.show("policy.mean", policy.output);
    if (config.head == Head::squashed_gaussian)
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

// log |d tanh(u) / du| = log(1 - tanh(u)^2) = 2 (log 2 - u - log(1 + exp(-2 u))), exact also where tanh rounds to 1.
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
        for (const Tensor<T>& input : inputs)
            if (input.gradient) gradient_of(input);
        for (ptrdiff_t i = 0; i < n; ++i) slope(i, y.grad()[i / columns]);
    });
    return y;
}

// log pi(a) of a = tanh(u), u ~ N(mean, exp(log_std)^2), summed over the action's dimensions: with u = atanh(a),
// sum of -((u - mean) / std)^2 / 2 - log_std - log(2 pi) / 2 - log(1 - a^2). actions [n, A], strictly inside (-1, 1).
// With z = (u - mean) / std the derivatives are z / std by the mean and z^2 - 1 by log_std; u does not depend on them.
template <class T>
Tensor<T> gaussian_log_prob(Tape<T>& tape, Policy<T> policy, const float* actions) {
    const Tensor<T> mean = policy.output, log_std = policy.log_std;
    const Tensor<T> u = tape.constant(actions, mean.rows, mean.columns);
    T* const deviation = tape.template scratch<T>(u.size());  // [n, A] exp(log_std)
    for (size_t i = 0; i < u.size(); ++i) {
        u.value[i] = std::atanh(u.value[i]);
        deviation[i] = std::exp(log_std.value[i]);
    }
    const auto standardised = [=](ptrdiff_t i) { return (u.value[i] - mean.value[i]) / deviation[i]; };
    const auto value = [=](ptrdiff_t i) {
        const T z = standardised(i);
        return T(-0.5) * z * z - log_std.value[i] - T(half_log_2_pi) - log_tanh_slope(u.value[i]);
    };
    return row_sums(tape, {mean, log_std}, u.rows, u.columns, value, [=](ptrdiff_t i, T dy) {
        const T z = standardised(i);
        mean.grad()[i] += dy * z / deviation[i];
        log_std.grad()[i] += dy * (z * z - T(1));
    });
}

// One-sample estimate of the entropy, -log pi(tanh(u)) with u = mean + exp(log_std) noise; noise [n, A] standard
// normal. The gradient flows through the sample, as ODT's does: the Gaussian term is then noise^2 / 2, a constant. The
// derivatives are -2 tanh(u) by the mean, and 1 - 2 tanh(u) exp(log_std) noise by log_std.
template <class T>
Tensor<T> gaussian_entropy(Tape<T>& tape, Policy<T> policy, const float* noise) {
    const Tensor<T> mean = policy.output, log_std = policy.log_std;
    const Tensor<T> n = tape.constant(noise, mean.rows, mean.columns);
    const auto sample = [=](ptrdiff_t i) { return mean.value[i] + std::exp(log_std.value[i]) * n.value[i]; };
    const auto value = [=](ptrdiff_t i) {
        return T(0.5) * n.value[i] * n.value[i] + log_std.value[i] + T(half_log_2_pi) + log_tanh_slope(sample(i));
    };
    return row_sums(tape, {mean, log_std}, n.rows, n.columns, value, [=](ptrdiff_t i, T dy) {
        const T slope = T(-2) * std::tanh(sample(i));  // of log_tanh_slope
        mean.grad()[i] += dy * slope;
        log_std.grad()[i] += dy * (T(1) + slope * std::exp(log_std.value[i]) * n.value[i]);
    });
}

// log pi(a): the entry of each row that the action names. log_p [n, moves]; actions [n, 1], whole numbers below moves.
// The derivative is 1 by that entry; log_softmax carries it on to the logits.
template <class T>
Tensor<T> categorical_log_prob(Tape<T>& tape, Tensor<T> log_p, const float* actions) {
    const Tensor<T> a = tape.constant(actions, log_p.rows, 1);
    const auto named = [=](ptrdiff_t row) { return row * log_p.columns + static_cast<ptrdiff_t>(a.value[row]); };
    return row_sums(
        tape, {log_p}, a.rows, 1, [=](ptrdiff_t row) { return log_p.value[named(row)]; },
        [=](ptrdiff_t row, T dy) { log_p.grad()[named(row)] += dy; });
}

// H = -sum p log p of each row, exact, in nats. log_p [n, moves]. The derivative by log p is -p (log p + 1).
template <class T>
Tensor<T> categorical_entropy(Tape<T>& tape, Tensor<T> log_p) {
    T* const p = tape.template scratch<T>(log_p.size());  // [n, moves] exp(log p), for the backward pass too
    const auto value = [=](ptrdiff_t i) {
        p[i] = std::exp(log_p.value[i]);
        return -p[i] * log_p.value[i];
    };
    return row_sums(tape, {log_p}, log_p.rows, log_p.columns, value,
                    [=](ptrdiff_t i, T dy) { log_p.grad()[i] -= dy * p[i] * (log_p.value[i] + T(1)); });
}

// DT's loss for continuous actions: the squared error of each row, averaged over the action's A dimensions.
// actions [n, A].
template <class T>
Tensor<T> squared_error(Tape<T>& tape, Tensor<T> prediction, const float* actions) {
    const Tensor<T> a = tape.constant(actions, prediction.rows, prediction.columns);
    const auto error = [=](ptrdiff_t i) { return prediction.value[i] - a.value[i]; };
    return row_sums(
        tape, {prediction}, a.rows, a.columns, [=](ptrdiff_t i) { return error(i) * error(i) / T(a.columns); },
        [=](ptrdiff_t i, T dy) { prediction.grad()[i] += dy * T(2) * error(i) / T(a.columns); });
}

// log pi(a) of each row, [n, 1]; for DT's deterministic head, minus its loss.
// actions: [n, A], for a categorical policy [n, 1] whole numbers.
template <class T>
Tensor<T> log_prob(Tape<T>& tape, const Policy<T>& policy, const float* actions) {
    if (policy.head == Head::categorical) return categorical_log_prob(tape, policy.output, actions);
    if (policy.head == Head::squashed_gaussian) return gaussian_log_prob(tape, policy, actions);
    const auto minus = [](T x) { return -x; };
    return elementwise(tape, squared_error(tape, policy.output, actions), minus, [](T, T) { return T(-1); });
}

// H(pi) of each row, [n, 1]: exact where the policy is categorical, else by one sample with the given standard normal
// noise [n, A]. Not for the deterministic head.
template <class T>
Tensor<T> entropy(Tape<T>& tape, const Policy<T>& policy, const float* noise) {
    if (policy.head == Head::categorical) return categorical_entropy(tape, policy.output);
    return gaussian_entropy(tape, policy, noise);
}

// sum of coefficient_i x_i, [1, 1], in order, of x [n, 1] and coefficients [n]. Backward: dx_i += coefficient_i dy.
template <class T, class Number>
Tensor<T> weighted_sum(Tape<T>& tape, Tensor<T> x, const Number* coefficients) {
    const Tensor<T> c = tape.constant(coefficients, x.rows, 1);
    return row_sums(
        tape, {x}, 1, x.rows, [=](ptrdiff_t i) { return c.value[i] * x.value[i]; },
        [=](ptrdiff_t i, T dy) { x.grad()[i] += c.value[i] * dy; });
}

// a x + b y, [1, 1], of x and y [1, 1]. Backward: dx += a dz, dy += b dz.
template <class T>
Tensor<T> combine(Tape<T>& tape, T a, Tensor<T> x, T b, Tensor<T> y) {
    const auto value = [=](ptrdiff_t) { return a * x.value[0] + b * y.value[0]; };
    return row_sums(tape, {x, y}, 1, 1, value, [=](ptrdiff_t, T dz) {
        x.grad()[0] += a * dz;
        y.grad()[0] += b * dz;
    });
}

// ---------------------------------------------------------------------------------------------------------------------
// Optimisers. One struct: LAMB and AdamW differ in where the weight decay goes and in the trust ratio; Adam is AdamW
// without decay. For update t = 1, 2, ... of a tensor theta with gradient g, weight decay c and learning rate r:
//
//     g <- g min(1, clip_norm / (|g| of all tensors + 1e-6))
//     m <- beta1 m + (1 - beta1) g          v <- beta2 v + (1 - beta2) g^2
//     u = (m / (1 - beta1^t)) / (sqrt(v / (1 - beta2^t)) + epsilon)
//     LAMB    u <- u + c theta;    theta <- theta - r (|theta| / |u|) u        You et al., ICLR 2020
//     AdamW                        theta <- (1 - r c) theta - r u              Loshchilov and Hutter, ICLR 2019

struct OptimizerConfig {
    enum class Rule { lamb, adamw } rule = Rule::lamb;
    double learning_rate = 1e-3, beta1 = 0.9, beta2 = 0.999, epsilon = 1e-8, weight_decay = 0;  // betas, epsilon: ODT's
    bool always_adapt = false;  // LAMB's trust ratio also without weight decay
    double clip_norm = 0.25;    // of the gradient over all tensors; 0: no clipping
    uint64_t warmup_updates = 10000;
};

// The state of an optimiser. `updates` is t of the equations after the update, and n of the warm-up before it.
struct Optimizer {
    uint64_t updates = 0;
    std::vector<std::vector<float>> first_moment, second_moment;  // m and v, one of each per parameter tensor
};

// Linear warm-up: the factor of update n = 0, 1, ... is min((n + 1) / warmup, 1). ODT's code.
inline double warmup_factor(uint64_t update, uint64_t warmup_updates) {
    return update + 1 >= warmup_updates ? 1.0 : static_cast<double>(update + 1) / static_cast<double>(warmup_updates);
}

// Updates work on blocks of this many elements. Sums of squares are taken in double: eight lanes within a block, the
// blocks added in order.
constexpr size_t update_block = 4096;

// The sum of squares of x [n], n <= update_block.
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

// The sum, block by block, of f(first, count) over the blocks of [0, n), which all threads share: a block's first
// element and how many it has. `work`: about how many operations a block.
template <class F>
double sum_of_blocks(Compute& compute, size_t n, int work, F&& f) {
    std::vector<double> sums(divide_up(n, update_block));
    for_rows(compute, static_cast<int>(sums.size()), work, [&](int begin, int end, int) {
        for (size_t b = begin; b < static_cast<size_t>(end); ++b)
            sums[b] = f(b * update_block, std::min(n - b * update_block, update_block));
    });
    return std::accumulate(sums.begin(), sums.end(), 0.0);
}

// The sum of squares of all of x.
template <class T>
double sum_of_squares(Compute& compute, const std::vector<T>& x) {
    return sum_of_blocks(compute, x.size(), update_block,
                         [&](size_t first, size_t count) { return block_of_squares(&x[first], count); });
}

// x^n by squaring: libm's pow in double differs between processors.
inline double power(double x, uint64_t n) {
    double result = 1;
    for (; n > 0; n /= 2, x *= x)
        if (n % 2 == 1) result *= x;
    return result;
}

// value = shrink value - rate u. Returns whether the result is infinite or NaN: not itself less itself.
ALWAYS_INLINE bool move_weight(float& value, float u, float shrink, float rate) {
    const float moved = shrink * value - rate * u;
    value = moved;
    return !(moved - moved == 0);
}

// m, v and the step u (before the learning rate) of n weights, from the clipped gradient.
//   m = beta1 m + (1 - beta1) g;  v = beta2 v + (1 - beta2) g^2
//   u = (m / (1 - beta1^t)) / (sqrt(v) / sqrt(1 - beta2^t) + epsilon), in LAMB + weight decay times value
// At_once: the step is made, the gradient is emptied, and what comes back is whether a value is not finite. Else u is
// written over the gradient, for apply_step().
template <bool At_once>
bool adam_step(float* __restrict gradient, float* __restrict m, float* __restrict v, float* __restrict value, size_t n,
               const OptimizerConfig& config, double scale, double bias1, double bias2, float shrink, float rate) {
    const float beta1 = static_cast<float>(config.beta1), beta2 = static_cast<float>(config.beta2);
    const float one_minus_1 = static_cast<float>(1 - config.beta1), one_minus_2 = static_cast<float>(1 - config.beta2);
    const float clip = static_cast<float>(scale), root_bias2 = static_cast<float>(std::sqrt(bias2));
    const float inverse_bias1 = static_cast<float>(1 / bias1), epsilon = static_cast<float>(config.epsilon);
    const float decay = config.rule == OptimizerConfig::Rule::lamb ? static_cast<float>(config.weight_decay) : 0.0f;
    int bad = 0;
    const auto run = [&](auto unbiased) {
        vectorised<float>([=, &bad](auto) INLINE_LAMBDA {
            int any = 0;
            for (size_t i = 0; i < n; ++i) {
                const float g = gradient[i] * clip;
                m[i] = beta1 * m[i] + one_minus_1 * g;
                v[i] = beta2 * v[i] + one_minus_2 * g * g;
                const float root = unbiased ? std::sqrt(v[i]) : std::sqrt(v[i]) / root_bias2;
                const float u = m[i] * inverse_bias1 / (root + epsilon) + decay * value[i];
                if (At_once) any |= move_weight(value[i], u, shrink, rate);
                gradient[i] = At_once ? 0.0f : u;
            }
            bad = any;
        });
    };
    // From update 16,628 on, if beta2 is 0.999, the correction is 1, and a slow division is saved.
    root_bias2 == 1.0f ? run(std::true_type{}) : run(std::false_type{});
    return bad != 0;
}

// Makes the steps u in `gradient`, which is emptied. Returns whether a value is not finite.
inline bool apply_step(float* __restrict value, float* __restrict gradient, size_t n, float shrink, float rate) {
    int bad = 0;
    vectorised<float>([=, &bad](auto) INLINE_LAMBDA {
        int any = 0;
        for (size_t i = 0; i < n; ++i) {
            any |= move_weight(value[i], gradient[i], shrink, rate);
            gradient[i] = 0;
        }
        bad = any;
    });
    return bad != 0;
}

// The norm of the gradient over all parameters. Errors: nn.not_finite names the tensor.
template <class T>
double gradient_norm(Compute& compute, const std::vector<Parameter<T>>& parameters) {
    double total = 0;
    for (const Parameter<T>& parameter : parameters) {
        const double squares = sum_of_squares(compute, parameter.gradient);
        if (!std::isfinite(squares)) fail("nn.not_finite", "the gradient of %s is not finite", parameter.name.c_str());
        total += squares;
    }
    return std::sqrt(total);
}

// One update of all parameters from their gradients; returns the gradient's norm before clipping. Gradients are 0 after
// it. A trust ratio takes three more passes over a tensor, because the norm of the whole step decides how far each
// weight goes: two for the norms of weights and step, which is written over the gradient, and one for the weights.
// LAMB as ODT has it: the trust ratio |theta| / |u| of each tensor (Q, K, V are one) has no bound, is 1 where either
// norm is 0, and is left out at weight decay 0 unless always_adapt. Errors: nn.not_finite names the tensor, before
// anything is changed (gradient), or after (value).
inline double update_parameters(Compute& compute, std::vector<Parameter<float>>& parameters, Optimizer& optimizer,
                                const OptimizerConfig& config) {
    const double norm = gradient_norm(compute, parameters);
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
        float *const gradient = parameter.gradient.data(), *const value = parameter.value.data();
        double bad = sum_of_blocks(compute, n, 16 * update_block, [&](size_t first, size_t count) {
            const auto step = adapt ? adam_step<false> : adam_step<true>;
            return step(gradient + first, m.data() + first, v.data() + first, value + first, count, config, scale,
                        bias1, bias2, shrink, static_cast<float>(learning_rate));
        });
        if (adapt) {
            const double value_norm = std::sqrt(sum_of_squares(compute, parameter.value));
            const double step_norm = std::sqrt(sum_of_squares(compute, parameter.gradient));
            double trust = 1;
            if (value_norm > 0 && step_norm > 0) trust = value_norm / step_norm;
            const float rate = static_cast<float>(learning_rate * trust);
            bad = sum_of_blocks(compute, n, 4 * update_block, [&](size_t first, size_t count) {
                return apply_step(value + first, gradient + first, count, shrink, rate);
            });
        }
        if (bad > 0) fail("nn.not_finite", "parameter %s is not finite after the update", parameter.name.c_str());
    }
    return norm;
}
