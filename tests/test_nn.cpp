// test_nn.cpp: nn.hpp against loops in double, closed forms, finite differences and published vectors.
//
// In order: random numbers; threads; matrix products; gradients; the transformer against a plain one; heads;
// initialisation; optimisers; dropout and memory.
#include <cstdio>
#include <functional>
#include <limits>
#include <string>
#include <vector>

#include "plain.hpp"
#include "test.hpp"

namespace {

constexpr double unit = 0x1p-24;  // largest relative error of a float rounding; bounds count roundings in it

// The numbers of one test, a function of test_seed() and the test's own number.
struct Draws {
    uint64_t test;
    uint32_t count = 0;
    Random random = {test_seed(), 1000};
    double normal() { return random.normal(test, count++); }
    double uniform() { return random.uniform(test, count++); }
    template <class T>
    std::vector<T> normals(size_t n, double scale = 1) {
        std::vector<T> x(n);
        for (T& value : x) value = static_cast<T>(scale * normal());
        return x;
    }
};

template <class T>
bool same_bits(const std::vector<T>& a, const std::vector<T>& b) {
    return a.size() == b.size() && (a.empty() || std::memcmp(a.data(), b.data(), a.size() * sizeof(T)) == 0);
}

template <class T>
std::vector<T> values(Tensor<T> x) {
    return {x.value, x.value + x.size()};
}

// What a failing statement says; empty if it does not fail.
std::string failure(const std::function<void()>& statement) {
    try {
        statement();
    } catch (const Error& error) {
        return error.id + ": " + error.what();
    }
    return "";
}

std::vector<const Kernel*> kernels_of_this_machine() {
    std::vector<const Kernel*> found;
    for (const Kernel* kernel : kernels) {
        if (kernel->supported())
            found.push_back(kernel);
        else
            std::printf("  this machine cannot run kernel %s: not tested\n", kernel->name);
    }
    return found;
}

Compute& serial() {
    static Compute compute(kernel_portable, 1);
    return compute;
}

}  // namespace

// ---------------------------------------------------------------------------------------------------------------------
// Random numbers

namespace {

// The call of Random that draws these four words: Philox is a bijection, so it can be run backwards.
struct Call {
    uint64_t step;
    uint32_t index, site;
};

Call call_that_draws(Words4 w, const Random& random) {
    const auto inverse = [](uint32_t odd) {  // modulo 2^32, by Newton
        uint32_t x = odd;
        for (int i = 0; i < 5; ++i) x *= 2 - odd * x;
        return x;
    };
    for (uint32_t round = 10; round-- > 0;) {
        const uint32_t key0 = random.seed + round * 0x9E3779B9, key1 = random.stream + round * 0xBB67AE85;
        const uint32_t c0 = w[3] * inverse(0xD2511F53), c2 = w[1] * inverse(0xCD9E8D57);
        const uint32_t high0 = static_cast<uint32_t>(uint64_t{0xD2511F53} * c0 >> 32),
                       high2 = static_cast<uint32_t>(uint64_t{0xCD9E8D57} * c2 >> 32);
        w = {c0, w[0] ^ high2 ^ key0, c2, w[2] ^ high0 ^ key1};
    }
    return {uint64_t{w[3]} << 32 | w[2], w[0], w[1]};
}

}  // namespace

TEST(philox_gives_the_published_known_answers) {  // Random123, kat_vectors
    constexpr uint32_t ff = 0xffffffff;
    CHECK((philox({0, 0, 0, 0}, 0, 0) == Words4{0x6627e8d5, 0xe169c58d, 0xbc57ac4c, 0x9b00dbd8}));
    CHECK((philox({ff, ff, ff, ff}, ff, ff) == Words4{0x408f276d, 0x41c83b0e, 0xa20bc7c6, 0x6d5451fd}));
    CHECK((philox({0x243f6a88, 0x85a308d3, 0x13198a2e, 0x03707344}, 0xa4093822, 0x299f31d0) ==
           Words4{0xd16cfe09, 0x94fdcceb, 0x5001e420, 0x24126ea1}));
}

TEST(many_counters_at_once_have_the_words_of_each) {
    for (uint32_t trial = 0; trial < 200; ++trial) {  // also where the counter wraps
        const Words4 counter = philox({trial, 1, 2, 3}, test_seed(), 0);
        const uint32_t first = trial % 2 == 0 ? counter[0] : 0xffffffff - trial % 32;
        uint32_t words[128];
        philox_words<32>(words, {first, counter[1], counter[2], counter[3]}, trial, test_seed());
        for (uint32_t i = 0; i < 32; ++i) {
            const Words4 one = philox({first + i, counter[1], counter[2], counter[3]}, trial, test_seed());
            for (uint32_t j = 0; j < 4; ++j) CHECK_EQUAL(words[4 * i + j], one[j]);
        }
    }
}

TEST(random_numbers_have_their_moments_within_five_sigma) {
    const Random random = {test_seed(), 3};
    constexpr int n = 100000;
    double mean = 0, square = 0, normal_moment[5] = {};
    for (uint32_t i = 0; i < n; ++i) {
        const double u = random.uniform(3, i), z = random.normal(4, i);
        CHECK(u >= 0 && u < 1);
        mean += u / n;
        square += u * u / n;
        for (int k = 1; k <= 4; ++k) normal_moment[k] += std::pow(z, k) / n;
    }
    const double five_sigma = 5 / std::sqrt(n);
    CHECK_CLOSE(mean, 0.5, five_sigma * std::sqrt(1.0 / 12));
    CHECK_CLOSE(square, 1.0 / 3, five_sigma * std::sqrt(4.0 / 45));
    CHECK_CLOSE(normal_moment[1], 0, five_sigma);
    CHECK_CLOSE(normal_moment[2], 1, five_sigma * std::sqrt(2));
    CHECK_CLOSE(normal_moment[3], 0, five_sigma * std::sqrt(15));
    CHECK_CLOSE(normal_moment[4], 3, five_sigma * std::sqrt(96));
}

TEST(below_is_unbiased_for_bounds_that_are_no_power_of_two) {
    const Random random = {test_seed(), 3};
    for (const uint64_t bound : {uint64_t{7}, uint64_t{14 * 104729}, uint64_t{7} << 61}) {
        constexpr int n = 70000;
        std::vector<int> count(7);
        for (uint32_t i = 0; i < n; ++i) {
            const uint64_t x = random.below(bound, 5, i);
            CHECK(x < bound);
            ++count[static_cast<size_t>(x / (bound / 7))];
        }
        double chi_square = 0;
        for (const int c : count) chi_square += (c - n / 7.0) * (c - n / 7.0) / (n / 7.0);
        CHECK_CLOSE(chi_square, 0,
                    40);  // 6 degrees of freedom: exceeded once in two million seeds
    }
    CHECK_EQUAL(random.below(1, 5, 0), 0u);
}

TEST(random_numbers_stay_in_range_at_the_extreme_words) {
    const Random random = {test_seed(), 3};
    const auto drawn = [&](Words4 words) {
        const Call call = call_that_draws(words, random);
        CHECK(random.words(call.step, call.index, call.site) == words);
        return call;
    };
    constexpr uint32_t ff = 0xffffffff;
    const Call low = drawn({0, 0, 0, 0}), high = drawn({ff, ff, ff, ff}), order = drawn({0, 1u << 31, 0, 1u << 31});
    CHECK_EQUAL(random.uniform(low.step, low.index, low.site), 0);
    CHECK_EQUAL(random.uniform(high.step, high.index, high.site), 1 - 0x1p-53);
    CHECK_EQUAL(random.uniform(order.step, order.index, order.site), 0.5);
    CHECK_EQUAL(random.below(1000, low.step, low.index, low.site), 0u);
    CHECK_EQUAL(random.below(1000, high.step, high.index, high.site), 999u);
    CHECK_EQUAL(random.below(1000, order.step, order.index, order.site), 500u);
    CHECK_CLOSE(random.normal(low.step, low.index, low.site), std::sqrt(48 * std::log(2.0)), 1e-6);
    CHECK_CLOSE(random.normal(order.step, order.index, order.site), -std::sqrt(48 * std::log(2.0)), 1e-6);
    CHECK_EQUAL(random.normal(high.step, high.index, high.site), 0.0f);
}

// ---------------------------------------------------------------------------------------------------------------------
// Threads

TEST(threads_run_every_task_exactly_once) {
    for (int count = 1; count <= 8; ++count) {
        Threads threads(count);
        CHECK_EQUAL(threads.count(), count);
        std::vector<std::atomic<int>> runs(50);
        for (int job = 0; job < 20000; ++job) {
            const int tasks = job % 100 == 0 ? 50 : job * 7 % 11;
            for (std::atomic<int>& r : runs) r.store(0, std::memory_order_relaxed);
            std::atomic<bool> known_worker = true;
            threads.run(tasks, [&](int task, int worker) {
                runs[static_cast<size_t>(task)].fetch_add(1, std::memory_order_relaxed);
                if (worker < 0 || worker >= count) known_worker = false;
            });
            bool once = known_worker;
            for (int task = 0; task < 50; ++task)
                once = once && runs[static_cast<size_t>(task)].load(std::memory_order_relaxed) == (task < tasks);
            CHECK(once);
        }
    }
}

TEST(threads_can_be_stopped_at_any_moment) {  // a deadlock would hang here
    for (int i = 0; i < 1000; ++i) {
        Threads threads(2 + i % 3);
        std::atomic<int> sum = 0;
        if (i % 2 == 1) threads.run(5, [&](int task, int) { sum += task; });
        CHECK_EQUAL(sum.load(), i % 2 == 1 ? 10 : 0);
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// Matrix products

namespace {

// A logical matrix [rows, columns] inside exactly as much memory as it needs, transposed or not, with a wide stride.
struct Stored {
    std::vector<float> memory;
    View<const float> view;
    Stored(const std::vector<float>& x, int rows, int columns, bool transposed, int gap) {
        const int lines = transposed ? columns : rows, width = transposed ? rows : columns;
        memory.resize(lines == 0 || width == 0 ? 0 : static_cast<size_t>((lines - 1) * (width + gap) + width));
        view = {memory.data(), width + gap, transposed};
        for (int i = 0; i < rows; ++i)
            for (int j = 0; j < columns; ++j) const_cast<float&>(view(i, j)) = x[static_cast<size_t>(i * columns + j)];
    }
};

// x to the nearest number of 8 bits of mantissa, of two the even one; for x whose exponent is far from the ends.
float rounded_to_bf16(float x) {
    int exponent = 0;
    const float mantissa = std::frexp(x, &exponent);
    return std::ldexp(std::nearbyint(std::ldexp(mantissa, 8)), exponent - 8);
}

// The definition told again, the multiply-add with one rounding or with two, or in pairs of bf16, the odd one first;
// and in double, with its error bound.
struct Product {
    float value;
    double exact, bound;
};

Product product(const float* a, const float* b, int K, int N, float start, const Kernel& kernel) {
    const bool fused = kernel.arithmetic() == std::string("fused"), bf16 = kernel.precision() == std::string("bf16");
    Product p = {start, start, std::fabs(start)};
    for (int first = 0; first < K; first += 256) {
        const int end = std::min(K, first + 256);
        float sum = 0;
        for (int k = first; bf16 && k < end + (end - first) % 2; ++k) {
            const int other = first + ((k - first) ^ 1);  // 1, 0, 3, 2, ...
            if (other < end) sum = std::fma(rounded_to_bf16(a[other]), rounded_to_bf16(b[other * N]), sum);
        }
        for (int k = first; k < end; ++k) {
            if (!bf16) sum = fused ? std::fma(a[k], b[k * N], sum) : sum + a[k] * b[k * N];
            p.exact += static_cast<double>(a[k]) * b[k * N];
            p.bound += std::fabs(static_cast<double>(a[k]) * b[k * N]);
        }
        p.value += sum;
    }
    const double rounding_of_inputs = bf16 ? 2 * 0x1p-8 + 0x1p-16 : 0;                        // 8 bits of mantissa each
    p.bound *= rounding_of_inputs + (std::min(K, 256) + (K + 255) / 256 + 1) * unit * 1.001;  // on the way to C
    return p;
}

// All layouts of one size on one Compute: every element of C has the definition's bits, nothing else is touched.
void check_matmul(Compute& compute, Draws& draws, int M, int N, int K) {
    const std::vector<float> a = draws.normals<float>(static_cast<size_t>(M * K)),
                             b = draws.normals<float>(static_cast<size_t>(K * N)),
                             start = draws.normals<float>(static_cast<size_t>((M + 1) * (N + 3)));
    std::vector<float> expected[2] = {start, start};  // overwrite, accumulate
    for (int i = 0; i < M; ++i)
        for (int j = 0; j < N; ++j)
            for (int store = 0; store < 2; ++store) {
                float& c = expected[store][static_cast<size_t>(i * (N + 3) + j)];
                const Product p = product(a.data() + i * K, b.data() + j, K, N, store == 0 ? 0.0f : c, compute.kernel);
                CHECK_CLOSE(p.value, p.exact, p.bound);
                c = p.value;
            }
    for (const bool a_transposed : {false, true})
        for (const bool b_transposed : {false, true})
            for (int store = 0; store < 2; ++store) {
                const int gap = a_transposed ? 5 : 0;
                const Stored stored_a(a, M, K, a_transposed, gap), stored_b(b, K, N, b_transposed, gap);
                std::vector<float> c = start, plain = start;
                const Store how = store == 0 ? Store::overwrite : Store::accumulate;
                matmul(compute, View<float>{c.data(), N + 3}, stored_a.view, stored_b.view, M, N, K, how);
                bool same = same_bits(c, expected[store]);
                if (compute.kernel.arithmetic() == std::string("plain")) {
                    const View<float> to = {plain.data(), N + 3};
                    matmul_plain(to, stored_a.view, stored_b.view, M, N, K, how);
                    same = same && same_bits(c, plain);
                }
                if (!same)
                    report_failure(__FILE__, __LINE__,
                                   std::string(compute.kernel.name) + " " + compute.kernel.arithmetic() + ", threads " +
                                       shown(compute.threads.count()) + ", M N K " + shown(M) + " " + shown(N) + " " +
                                       shown(K) + ", transposed " + shown(a_transposed) + shown(b_transposed) +
                                       ", store " + shown(store));
            }
}

}  // namespace

TEST(matmul_has_the_bits_of_its_definition_around_every_tile_edge) {
    Draws draws = {1};
    for (const Kernel* kernel : kernels_of_this_machine()) {
        Compute compute(*kernel, 1);
        const int r = kernel->tile_rows, c = kernel->tile_columns;
        for (const int K : {0, 1, 255, 256, 257, 513})
            for (const int M : {0, 1, r - 1, r, r + 1, 2 * r + 1, 4 * r + 1})
                for (const int N : {0, 1, c - 1, c, c + 1, 2 * c})
                    if (K < 300 || (M != r - 1 && N != c - 1 && M <= r + 1 && N <= c + 1))
                        check_matmul(compute, draws, M, N, K);
    }
}

// Cuts the work of a single thread as for more than there are; it does the tasks backwards.
void pretend(Threads& threads, int count) {
    threads.pretended = count;
    threads.rehearse = [](int tasks, const std::function<void(int, int)>& f) {
        while (tasks-- > 0) f(tasks, 0);
    };
}

TEST(matmul_gives_the_same_bits_for_any_number_of_threads) {
    Draws draws = {2};
    for (const Kernel* kernel : kernels_of_this_machine())
        for (const int threads : {2, 3, 5, 8, 64}) {
            Compute compute(*kernel, threads == 64 ? 1 : threads);
            if (threads == 64) pretend(compute.threads, threads);
            check_matmul(compute, draws, 109, 3 * kernel->tile_columns + 1, 260);  // many rows; blocks of rows
            check_matmul(compute, draws, 3, 9 * kernel->tile_columns, 70);         // wide: blocks of columns
            check_matmul(compute, draws, 401, 5, 30);
        }
}

TEST(matmul_packs_a_frozen_weight_once_and_again_when_frozen_anew) {
    Draws draws = {4};
    constexpr int M = 20, N = 67, K = 300;
    const std::vector<float> a = draws.normals<float>(M * K);
    for (const Kernel* kernel : kernels_of_this_machine())
        for (const bool transposed : {false, true}) {
            Compute compute(*kernel, 2);
            std::vector<float> b = draws.normals<float>(K * N);
            const auto times = [&](bool weight) {
                std::vector<float> c(M * N);
                const View<const float> view = {b.data(), transposed ? K : N, transposed, weight};
                matmul(compute, View<float>{c.data(), N}, {a.data(), K}, view, M, N, K, Store::overwrite);
                return c;
            };
            for (int period = 0; period < 2; ++period) {
                const std::vector<float> expected = times(false);
                {
                    const FrozenWeights frozen(compute);
                    CHECK(same_bits(times(true), expected));
                    b[5] += 1;  // which no one may do: this shows that the weight is not read again
                    CHECK(same_bits(times(true), expected));
                    CHECK(!same_bits(times(false), expected));
                }
                CHECK(same_bits(times(true), times(false)));
            }
        }
}

TEST(matmul_of_one_row_equals_that_row_among_a_hundred) {
    Draws draws = {3};
    constexpr int M = 100, N = 64, K = 300;
    const std::vector<float> a = draws.normals<float>(M * K), b = draws.normals<float>(K * N);
    for (const Kernel* kernel : kernels_of_this_machine()) {
        Compute compute(*kernel, 2);
        std::vector<float> all(M * N), one(N);
        matmul(compute, View<float>{all.data(), N}, {a.data(), K}, {b.data(), N}, M, N, K, Store::overwrite);
        for (int i = 0; i < M; ++i) {
            matmul(compute, View<float>{one.data(), N}, {a.data() + i * K, K}, {b.data(), N}, 1, N, K,
                   Store::overwrite);
            CHECK(std::memcmp(one.data(), all.data() + i * N, sizeof(float) * N) == 0);
        }
    }
}

TEST(products_that_are_not_finite_stay_so_in_every_kernel) {
    for (const Kernel* kernel : kernels_of_this_machine())
        for (const float bad : {NAN, INFINITY}) {
            Compute compute(*kernel, 1);
            float a[40], b[40], c = 0;
            std::fill_n(a, 40, 1.0f), std::fill_n(b, 40, 1.0f);
            a[33] = bad;
            matmul(compute, View<float>{&c, 1}, {a, 40}, {b, 1}, 1, 1, 40, Store::overwrite);
            CHECK(!std::isfinite(c));
        }
}

TEST(bias_and_relu_are_applied_once_after_the_last_addition) {
    constexpr int M = 101, N = 70;
    Draws draws = {5};
    const std::vector<float> a = draws.normals<float>(M * 600), b = draws.normals<float>(600 * N),
                             bias = draws.normals<float>(N);
    for (const Kernel* kernel : kernels_of_this_machine())
        for (const int threads : {1, 3})
            for (const int K : {0, 600})
                for (const bool relu : {false, true}) {
                    Compute compute(*kernel, threads);
                    std::vector<float> plain(M * N, 2.0f), c(M * N, 2.0f);
                    const View<const float> view_a = {a.data(), K}, view_b = {b.data(), N};
                    matmul(compute, View<float>{plain.data(), N}, view_a, view_b, M, N, K, Store::accumulate);
                    matmul(compute, View<float>{c.data(), N}, view_a, view_b, M, N, K, Store::accumulate,
                           {bias.data(), relu});
                    for (size_t i = 0; i < plain.size(); ++i) {
                        plain[i] += bias[i % N];
                        if (relu && plain[i] < 0) plain[i] = 0;
                    }
                    CHECK(same_bits(c, plain));
                }
    float c = NAN;
    apply_epilogue<float>({&c, 1}, {nullptr, true}, {0, 1, 0, 1});
    CHECK(std::isnan(c));
}

TEST(bf16_rounds_to_the_nearest_and_of_two_to_the_even_one) {
    const std::pair<float, uint32_t> cases[] = {
        {1.0f, 0x3f80},       {0x1.01p0f, 0x3f80},     {0x1.03p0f, 0x3f82}, {0x1.0102p0f, 0x3f81},
        {-0x1.03p0f, 0xbf82}, {0x1.ffp127f, 0x7f80},   {INFINITY, 0x7f80},  {0.0f, 0},
        {-0.0f, 0x8000},      {-0x1.fffp-127f, 0x8000}};
    for (const auto& [x, bits] : cases) CHECK_EQUAL(to_bf16(x), bits);
    CHECK(std::isnan(std::bit_cast<float>(to_bf16(std::bit_cast<float>(0x7f800001)) << 16)));
}

// The instruction that packs against the definition: every upper half of a float, with lower halves around the tie.
TEST(numbers_are_packed_as_bf16_by_the_definition) {
    constexpr int depth = 64, lines = 32;
    for (const Kernel* kernel : kernels_of_this_machine()) {
        if (kernel->precision() != std::string("bf16")) continue;
        for (const uint32_t low : {0u, 1u, 0x7fffu, 0x8000u, 0x8001u, 0xffffu})
            for (uint32_t upper = 0; upper < 0x10000; upper += depth * lines) {
                std::vector<float> x;  // [depth, lines]
                for (uint32_t i = 0; i < depth * lines; ++i) x.push_back(std::bit_cast<float>((upper + i) << 16 | low));
                for (const bool transposed : {false, true}) {
                    const View<const float> view = {x.data(), transposed ? depth : lines, transposed};
                    const int width = kernel->tile_rows;
                    std::vector<uint16_t> panel(depth * width);  // [depth / 2, width, 2]
                    kernel->pack_a(panel.data(), view, 0, 0, depth, width);
                    int wrong = 0;
                    for (int k = 0; k < depth; ++k)
                        for (int line = 0; line < width; ++line)
                            wrong += panel[(k / 2 * width + line) * 2 + k % 2] != to_bf16(view(k, line));
                    CHECK_EQUAL(wrong, 0);
                }
            }
    }
}

// vdpbf16ps against its definition, on all kinds of numbers: subnormal, zero, infinite, NaN, sums that cancel or
// overflow.
TEST(bf16_kernels_have_the_same_bits_on_all_kinds_of_numbers) {
    Draws draws = {25};
    const Random random = {test_seed(), 1002};
    const float special[] = {0.0f,       -0.0f,         0x1p-133f,     -0x1.fp-127f, 0x1p-126f, 0x1p-64f,
                             0x1.8p-63f, 1.0f,          -0x1.01p0f,    0x1.fep127f,  INFINITY,  -INFINITY,
                             NAN,        0x1.ffffp127f, 0x1.00ffffp0f, 0x1.018p0f};
    // A sum that is too small counts as zero, which no kernel can show: its sums have been rounded so already.
    CHECK_EQUAL(bf16_multiply_add(0x1p-127f, 0x1p-63f, 0x1p-63f), 0x1p-126f);
    constexpr int size = 48, depth = 6;
    std::vector<const Kernel*> found;
    for (const Kernel* kernel : kernels_of_this_machine())
        if (kernel->precision() == std::string("bf16")) found.push_back(kernel);
    for (uint32_t round = 0; round < 200; ++round) {
        std::vector<float> a, b;
        for (uint32_t i = 0; i < size * depth; ++i) {
            const bool chosen = random.below(4, round, i) == 0;
            a.push_back(chosen ? special[random.below(16, round, i, 1)]
                               : static_cast<float>(draws.normal()) * 0x1p-63f);
            b.push_back(chosen ? static_cast<float>(draws.normal()) : special[random.below(9, round, i, 2)]);
        }
        std::vector<float> first;
        for (const Kernel* kernel : found) {
            Compute compute(*kernel, 1);
            std::vector<float> c(size * size);
            matmul(compute, View<float>{c.data(), size}, {a.data(), depth}, {b.data(), size}, size, size, depth,
                   Store::overwrite);
            for (float& x : c)
                if (std::isnan(x)) x = 7;  // a NaN's payload is not part of the definition
            if (first.empty()) first = c;
            CHECK(same_bits(c, first));
        }
    }
}

TEST(the_best_kernel_is_the_first_that_the_machine_supports) {
    CHECK_EQUAL(&best_kernel(), kernels_of_this_machine().front());
    CHECK_EQUAL(kernel_portable.arithmetic(), std::string("plain"));
    CHECK(kernel_portable.supported());
}

TEST(dot_equals_the_sum_in_double) {
    Draws draws = {4};
    for (int n = 0; n <= 70; ++n) {
        const std::vector<float> a = draws.normals<float>(70), b = draws.normals<float>(70);
        double exact = 0, bound = 0;
        for (size_t i = 0; i < static_cast<size_t>(n); ++i) {
            exact += static_cast<double>(a[i]) * b[i];
            bound += std::fabs(static_cast<double>(a[i]) * b[i]);
        }
        CHECK_CLOSE(dot(a.data(), b.data(), n), exact, bound * (n / 16 + 20) * unit);
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// Gradients, in double

namespace {

using Build = std::function<Tensor<double>(Tape<double>&)>;
constexpr double earlier_gradient = 3;  // gradients are added to what is there

Parameter<double> leaf(Draws& draws, int rows, int columns, double scale = 1) {
    const size_t n = static_cast<size_t>(rows) * static_cast<size_t>(columns);
    return {"leaf",
            {static_cast<uint64_t>(rows), static_cast<uint64_t>(columns)},
            draws.normals<double>(n, scale),
            std::vector<double>(n, earlier_gradient)};
}

// A fixed random combination of the elements of what `build` makes; with its gradient if `backward`.
double probe(Tape<double>& tape, const Build& build, bool backward) {
    tape.reset();
    const Tensor<double> y = build(tape);
    const Random random = {test_seed(), 1001};
    double sum = 0;
    for (uint32_t i = 0; i < y.size(); ++i) sum += random.normal(0, i) * y.value[i];
    if (!backward) return sum;
    tape.on_backward({}, [=] {
        for (uint32_t i = 0; i < y.size(); ++i) gradient_of(y)[i] += random.normal(0, i);
    });
    tape.backward(tape.make(1, 1));
    return sum;
}

// A group of gradient checks; prints the worst relative error when it goes.
struct Gradients {
    const char* group;
    double worst = 0;

    ~Gradients() { std::printf("  worst relative error of a gradient of %s: %.1e\n", group, worst); }
    void check(const char* what, const Build& build, const std::vector<Parameter<double>*>& leaves, double at_most);
    void check(const char* what, const Build& build, const std::vector<Parameter<double>*>& leaves) {
        check(what, build, leaves, 1e9);
    }
};

// The gradient of `build` with respect to every element of the leaves (of larger ones: about `at_most` drawn elements)
// against central differences of fourth order. Where a ReLU bends between the points, or the function is steep, a
// smaller step decides. Relative to the element, or to 1/100 of the tensor's largest one.
void Gradients::check(const char* what, const Build& build, const std::vector<Parameter<double>*>& leaves,
                      double at_most) {
    Tape<double> tape(serial());
    tape.dropout_random.seed = test_seed();
    tape.dropout_step = 7;
    Draws draws = {5};
    for (Parameter<double>* x : leaves) x->gradient.assign(x->value.size(), earlier_gradient);
    probe(tape, build, true);
    for (Parameter<double>* x : leaves) {
        double largest = 0;
        for (const double g : x->gradient) largest = std::max(largest, std::fabs(g - earlier_gradient));
        if (largest == 0)
            report_failure(__FILE__, __LINE__, std::string(what) + ", " + x->name + ": all gradients are zero");
        for (size_t i = 0; i < x->value.size(); ++i) {
            if (draws.uniform() * static_cast<double>(x->value.size()) > at_most) continue;
            const double g = x->gradient[i] - earlier_gradient, start = x->value[i];
            const auto at = [&](double moved) {
                x->value[i] = start + moved;
                return probe(tape, build, false);
            };
            double error = 1;
            for (double h = 1e-3; h > 1e-7 && error > 1e-9; h /= 8) {
                const double slope = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h);
                error = std::min(error, std::fabs(slope - g) / std::max(std::fabs(g), largest / 100));
            }
            x->value[i] = start;
            worst = std::max(worst, error);
            if (!(error < 1e-7))
                report_failure(__FILE__, __LINE__,
                               std::string(what) + ", " + x->name + "[" + shown(i) + "]: gradient " + shown(g) +
                                   " differs from central differences by a relative " + shown(error));
        }
    }
}

Dropout dropout_of(const Tape<double>& tape, float probability) { return dropout_at(tape, 2, probability); }

}  // namespace

TEST(gradients_of_linear_equal_central_differences) {
    Draws draws = {6};
    Gradients gradients = {"linear"};
    for (const Layout layout : {Layout::out_in, Layout::in_out}) {
        const bool out_in = layout == Layout::out_in;
        Parameter<double> x = leaf(draws, 5, 3), w = leaf(draws, out_in ? 7 : 3, out_in ? 3 : 7), b = leaf(draws, 1, 7);
        for (const int count : {7, 4}) {  // all columns, or a slice
            const Build build = [&](Tape<double>& tape) {
                return linear(tape, x.tensor(), {w.tensor(), b.tensor(), layout}, count == 7 ? 0 : 2, count);
            };
            gradients.check("linear", build, {&x, &w, &b});
        }
    }
}

TEST(gradients_of_layer_norm_equal_central_differences) {
    Draws draws = {7};
    Parameter<double> x = leaf(draws, 4, 7), constant = leaf(draws, 1, 7), w = leaf(draws, 1, 7), b = leaf(draws, 1, 7),
                      wide = leaf(draws, 2, 37), wide_w = leaf(draws, 1, 37), wide_b = leaf(draws, 1, 37);
    for (size_t j = 0; j < 7; ++j) x.value[7 + j] += 1000;  // a large mean
    constant.value.assign(7, 2.5);                          // no variance but the 1e-5
    const auto build = [](Parameter<double>& in, Parameter<double>& weight, Parameter<double>& bias) {
        return [&](Tape<double>& tape) { return layer_norm(tape, in.tensor(), {weight.tensor(), bias.tensor()}); };
    };
    Parameter<double> w2 = w;
    Gradients gradients = {"layer_norm"};
    gradients.check("layer_norm", build(x, w, b), {&x, &w, &b});
    gradients.check("layer_norm, wide", build(wide, wide_w, wide_b), {&wide, &wide_w, &wide_b});
    // The weight of a constant row has no gradient: all its normalised elements are zero.
    gradients.check("layer_norm, constant", build(constant, w2, b), {&constant, &b});
    for (const double g : w2.gradient) CHECK_EQUAL(g, earlier_gradient);
}

TEST(gradients_of_small_operations_equal_central_differences) {
    Draws draws = {8};
    Parameter<double> x = leaf(draws, 5, 3), y = leaf(draws, 5, 3), column = leaf(draws, 5, 1), one = leaf(draws, 1, 1),
                      two = leaf(draws, 1, 1), table = leaf(draws, 4, 3);
    const std::vector<float> weights = draws.normals<float>(5);
    const std::vector<int> rows = {4, 0, 3}, places = {6, 1, 0, 5, 2}, index = {3, 0, 3, 1, 2};
    Parameter<double> w = leaf(draws, 3, 3), b = leaf(draws, 1, 3), norm_w = leaf(draws, 1, 3),
                      norm_b = leaf(draws, 1, 3);
    const Affine<double> affine = {w.tensor(), b.tensor(), Layout::out_in};
    const auto dropped = [&](float p, bool residual) {
        return [&, p, residual](Tape<double>& tape) {
            return dropout_add(tape, linear(tape, x.tensor(), affine), dropout_of(tape, p),
                               residual ? y.tensor() : Tensor<double>{});
        };
    };
    Gradients gradients = {"the small operations"};
    gradients.check("select_rows", [&](auto& t) { return select_rows(t, x.tensor(), rows.data(), 3); }, {&x});
    gradients.check("linear, dropout, residual", dropped(0, true), {&x, &y, &w, &b});
    gradients.check("linear, dropout, residual, p 0.4", dropped(0.4f, true), {&x, &y, &w, &b});
    gradients.check("linear, dropout, p 0.4", dropped(0.4f, false), {&x, &w, &b});
    gradients.check("linear, relu", [&](auto& t) { return linear(t, x.tensor(), affine, Activation::relu); },
                    {&x, &w, &b});
    gradients.check(
        "layer_norm, dropout, p 0.4",
        [&](auto& t) {
            return dropout_add(t, layer_norm(t, x.tensor(), {norm_w.tensor(), norm_b.tensor()}), dropout_of(t, 0.4f));
        },
        {&x, &norm_w, &norm_b});
    gradients.check("tanh_of", [&](auto& t) { return tanh_of(t, x.tensor()); }, {&x});
    gradients.check("squash_log_std", [&](auto& t) { return squash_log_std(t, x.tensor()); }, {&x});
    gradients.check("add_rows_by_index",
                    [&](auto& t) {
                        const Tensor<double> to = t.make(7, 3);
                        std::fill_n(to.value, to.size(), 0.0);
                        add_rows_by_index(t, to, places.data(), x.tensor(), nullptr, x.tensor().rows);
                        add_rows_by_index(t, to, places.data(), table.tensor(), index.data(), x.tensor().rows);
                        return to;
                    },
                    {&x, &table});
    gradients.check("weighted_sum", [&](auto& t) { return weighted_sum(t, column.tensor(), weights.data()); },
                    {&column});
    gradients.check("combine", [&](auto& t) { return combine(t, 0.7, one.tensor(), -2.0, two.tensor()); },
                    {&one, &two});
    gradients.check("a tensor used twice",
                    [&](auto& t) {
                        return dropout_add(t, linear(t, x.tensor(), affine), dropout_of(t, 0), tanh_of(t, x.tensor()));
                    },
                    {&x});
}

TEST(gradients_of_attention_equal_central_differences) {
    Draws draws = {9};
    Gradients gradients = {"attention"};
    const std::vector<Span> all = {{0, 1, 0, 1}, {1, 4, 1, 4}, {5, 3, 5, 3}},
                            some = {{0, 1, 0, 1}, {1, 4, 1, 2}, {5, 3, 3, 1}};
    const std::vector<int> everyone = {0, 1, 2, 3, 4, 5, 6, 7}, asking = {0, 2, 4, 6};
    for (const int heads : {1, 2})
        for (const bool subset : {false, true})
            for (const float p : {0.0f, 0.3f}) {
                Parameter<double> q = leaf(draws, subset ? 4 : 8, 6), kv = leaf(draws, 8, 12);
                const Build build = [&](Tape<double>& tape) {
                    return attention(tape, q.tensor(), kv.tensor(), 6, (subset ? some : all).data(), 3,
                                     (subset ? asking : everyone).data(), heads, dropout_of(tape, p));
                };
                gradients.check("attention", build, {&q, &kv});
                Parameter<double> qkv = leaf(draws, 8, 18);  // one tensor, as every layer but the last has it
                const Build build_of_one = [&](Tape<double>& tape) {
                    const Tensor<double> one = qkv.tensor();
                    return attention(tape, one, one, 6, all.data(), 3, everyone.data(), heads, dropout_of(tape, p));
                };
                gradients.check("attention of one tensor", build_of_one, {&qkv});
            }
    Parameter<double> wide = leaf(draws, 8, 3 * 148);  // heads of 128 or 64 columns at a time, 16, and 4 more
    const Build build = [&](Tape<double>& tape) {
        return attention(tape, wide.tensor(), wide.tensor(), 148, all.data(), 3, everyone.data(), 1,
                         dropout_of(tape, 0.3f));
    };
    gradients.check("attention of wide heads", build, {&wide}, 40);
}

TEST(gradients_of_the_heads_equal_central_differences) {
    Draws draws = {10};
    Parameter<double> mean = leaf(draws, 5, 3), log_std = leaf(draws, 5, 3), logits = leaf(draws, 5, 4, 3);
    const std::vector<float> noise = draws.normals<float>(15), moves = {2, 0, 3, 3, 1};
    std::vector<float> actions = draws.normals<float>(15);
    for (float& a : actions) a = std::tanh(a);
    const auto policy = [&] { return Policy<double>{Head::squashed_gaussian, mean.tensor(), log_std.tensor()}; };
    Gradients gradients = {"the heads"};
    gradients.check("gaussian_log_prob", [&](auto& t) { return gaussian_log_prob(t, policy(), actions.data()); },
                    {&mean, &log_std});
    gradients.check("gaussian_entropy", [&](auto& t) { return gaussian_entropy(t, policy(), noise.data()); },
                    {&mean, &log_std});
    gradients.check("log_softmax", [&](auto& t) { return log_softmax(t, logits.tensor()); }, {&logits});
    gradients.check("categorical_log_prob",
                    [&](auto& t) { return categorical_log_prob(t, logits.tensor(), moves.data()); }, {&logits});
    gradients.check("categorical_entropy", [&](auto& t) { return categorical_entropy(t, logits.tensor()); }, {&logits});
    gradients.check("squared_error", [&](auto& t) { return squared_error(t, mean.tensor(), actions.data()); }, {&mean});
}

// ---------------------------------------------------------------------------------------------------------------------
// The transformer

namespace {

constexpr int state_dim = 3, action_dim = 2;

SequenceBatch random_batch(Draws& draws, const std::vector<int>& lengths) {
    SequenceBatch batch;
    batch.lengths = lengths;
    size_t n = 0;
    for (const int length : lengths) {
        for (int c = 0; c < length; ++c) batch.timesteps.push_back(2 * c + length);
        n += static_cast<size_t>(length);
    }
    batch.returns_to_go = draws.normals<float>(n);
    batch.states = draws.normals<float>(n * state_dim);
    batch.actions = draws.normals<float>(n * action_dim);
    for (float& a : batch.actions) a = std::tanh(a);
    return batch;
}

// One window of a batch, alone.
SequenceBatch window_of(const SequenceBatch& batch, size_t window) {
    int first = 0;
    for (size_t w = 0; w < window; ++w) first += batch.lengths[w];
    const int n = batch.lengths[window];
    const auto part = [=](const auto& x, int width) {
        return std::decay_t<decltype(x)>(x.begin() + first * width, x.begin() + (first + n) * width);
    };
    return {{n},
            part(batch.returns_to_go, 1),
            part(batch.states, state_dim),
            part(batch.actions, action_dim),
            part(batch.timesteps, 1)};
}

// All parameters far from their start values, where too many are 0, 1 or small: biases, LayerNorms, attention.
template <class T>
void scatter(Transformer<T>& model, Draws& draws) {
    for (Parameter<T>& parameter : model.parameters)
        for (T& value : parameter.value)
            value = static_cast<T>(0.3 * static_cast<double>(value) + 0.4 * draws.normal());
}

TransformerConfig tiny(Head head, int max_timesteps, float dropout) {
    return {state_dim, action_dim, 2, 2, 8, max_timesteps, dropout, head};
}

// The decision transformer as the papers draw it, in double: every token, every query, an explicit mask.
using Matrix = std::vector<std::vector<double>>;

template <class T>
struct PlainTransformer {
    const Transformer<T>& model;

    const Parameter<T>& named(const std::string& name) const {
        for (const Parameter<T>& parameter : model.parameters)
            if (parameter.name == name) return parameter;
        throw Error("test", "no parameter " + name);
    }
    Matrix affine(const Matrix& x, const std::string& name, bool out_in) const {
        const Parameter<T>&w = named(name + ".weight"), &b = named(name + ".bias");
        Matrix y(x.size(), std::vector<double>(b.value.begin(), b.value.end()));
        for (size_t i = 0; i < x.size(); ++i)
            for (size_t o = 0; o < y[i].size(); ++o)
                for (size_t k = 0; k < x[i].size(); ++k)
                    y[i][o] +=
                        x[i][k] * static_cast<double>(w.value[out_in ? o * x[i].size() + k : k * y[i].size() + o]);
        return y;
    }
    Matrix norm(Matrix x, const std::string& name) const {
        const Parameter<T>&w = named(name + ".weight"), &b = named(name + ".bias");
        for (std::vector<double>& row : x) {
            const double d = static_cast<double>(row.size());
            double mean = 0, variance = 0;
            for (const double v : row) mean += v / d;
            for (const double v : row) variance += (v - mean) * (v - mean) / d;
            for (size_t j = 0; j < row.size(); ++j)
                row[j] = (row[j] - mean) / std::sqrt(variance + 1e-5) * static_cast<double>(w.value[j]) +
                         static_cast<double>(b.value[j]);
        }
        return x;
    }
    Matrix attend(const Matrix& qkv) const {
        const size_t n = qkv.size(), d = qkv[0].size() / 3, size = d / static_cast<size_t>(model.config.heads);
        Matrix out(n, std::vector<double>(d, 0));
        for (size_t c = 0; c < d; ++c)  // a column at a time, its head's weights computed anew
            for (size_t i = 0; i < n; ++i) {
                std::vector<double> weight(n, 0);
                double total = 0;
                for (size_t j = 0; j < n; ++j) {
                    double score = 0;
                    for (size_t e = c / size * size; e < (c / size + 1) * size; ++e) score += qkv[i][e] * qkv[j][d + e];
                    if (j > i) score = -std::numeric_limits<double>::infinity();
                    total += weight[j] = std::exp(score / std::sqrt(static_cast<double>(size)));
                }
                for (size_t j = 0; j < n; ++j) out[i][c] += weight[j] / total * qkv[j][2 * d + c];
            }
        return out;
    }
    static Matrix sum(Matrix x, const Matrix& y) {
        for (size_t i = 0; i < x.size(); ++i)
            for (size_t j = 0; j < x[i].size(); ++j) x[i][j] += y[i][j];
        return x;
    }
    // The output layers' input at every state token of one window, [steps, width].
    Matrix run(const SequenceBatch& window) const {
        Matrix x;
        for (size_t c = 0; c < window.timesteps.size(); ++c) {
            const auto part = [=](const std::vector<float>& v, size_t width) {
                return Matrix{{v.begin() + static_cast<ptrdiff_t>(c * width),
                               v.begin() + static_cast<ptrdiff_t>((c + 1) * width)}};
            };
            x.push_back(affine(part(window.returns_to_go, 1), "embed_return", true)[0]);
            x.push_back(affine(part(window.states, state_dim), "embed_state", true)[0]);
            x.push_back(affine(part(window.actions, action_dim), "embed_action", true)[0]);
            if (model.config.max_timesteps == 0) continue;
            const size_t row = static_cast<size_t>(std::min(window.timesteps[c], model.config.max_timesteps - 1));
            for (size_t token = 3 * c; token < 3 * c + 3; ++token)
                for (size_t j = 0; j < x[0].size(); ++j)
                    x[token][j] += static_cast<double>(named("embed_ordering.weight").value[row * x[0].size() + j]);
        }
        x = norm(x, "embed_ln");
        for (int layer = 0; layer < model.config.layers; ++layer) {
            const std::string h = "transformer.h." + std::to_string(layer) + ".";
            x = sum(x, affine(attend(affine(norm(x, h + "ln_1"), h + "attn.c_attn", false)), h + "attn.c_proj", false));
            Matrix hidden = affine(norm(x, h + "ln_2"), h + "mlp.c_fc", false);
            for (std::vector<double>& row : hidden)
                for (double& v : row) v = std::max(v, 0.0);
            x = sum(x, affine(hidden, h + "mlp.c_proj", false));
        }
        x = norm(x, "transformer.ln_f");
        Matrix states;
        for (size_t c = 0; c < window.timesteps.size(); ++c) states.push_back(x[3 * c + 1]);
        return states;
    }
};

template <class T>
void check_against_plain(double bound) {
    Draws draws = {11};
    Compute compute(best_kernel(), 2);
    for (const Head head : {Head::squashed_gaussian, Head::categorical, Head::deterministic})
        for (const int max_timesteps : {0, 5})
            for (const std::vector<int>& lengths : {std::vector<int>{1, 1}, {4}, {1, 3, 4, 2}}) {
                Transformer<T> model(tiny(head, max_timesteps, 0.1f), test_seed());
                scatter(model, draws);
                const SequenceBatch batch = random_batch(draws, lengths);
                Tape<T> tape(compute);
                tape.recording = false;
                const Policy<T> every = forward(tape, model, batch, Queries::every_state),
                                last = forward(tape, model, batch, Queries::last_state);
                CHECK_EQUAL(every.output.rows, batch.steps());
                CHECK_EQUAL(last.output.rows, static_cast<int>(lengths.size()));
                const PlainTransformer<T> plain = {model};
                const bool gaussian = head == Head::squashed_gaussian;
                const char* names[] = {"predict_action.mu", "predict_action.logits", "predict_action.0"};
                size_t at = 0;
                for (size_t w = 0; w < lengths.size(); ++w) {
                    const Matrix states = plain.run(window_of(batch, w));
                    const Matrix mean = plain.affine(states, names[static_cast<int>(head)], true);
                    for (size_t c = 0; c < mean.size(); ++c, at += action_dim)
                        for (size_t j = 0; j < action_dim; ++j) {
                            double expected = mean[c][j], total = 0;
                            if (head == Head::deterministic) expected = std::tanh(expected);
                            for (const double logit : mean[c]) total += std::exp(logit);
                            if (head == Head::categorical) expected -= std::log(total);
                            CHECK_CLOSE(every.output.value[at + j], expected, bound * (1 + std::fabs(expected)));
                            if (c + 1 == mean.size())
                                CHECK_EQUAL(last.output.value[w * 2 + j], every.output.value[at + j]);
                            if (!gaussian) continue;
                            const double raw = plain.affine(states, "predict_action.log_std", true)[c][j];
                            const double log_std = -5 + 0.5 * (2 - -5) * (std::tanh(raw) + 1);
                            CHECK_CLOSE(every.log_std.value[at + j], log_std, 7 * bound);
                            if (c + 1 == mean.size())
                                CHECK_EQUAL(last.log_std.value[w * 2 + j], every.log_std.value[at + j]);
                        }
                }
            }
}

}  // namespace

TEST(gradients_of_a_whole_transformer_equal_central_differences) {
    Draws draws = {12};
    Gradients gradients = {"the whole transformer"};
    for (const Head head : {Head::squashed_gaussian, Head::categorical, Head::deterministic})
        for (const int max_timesteps : {0, 5})
            for (const Queries queries : {Queries::every_state, Queries::last_state}) {
                Transformer<double> model(tiny(head, max_timesteps, 0.1f), test_seed());
                scatter(model, draws);
                const SequenceBatch batch = random_batch(draws, {1, 3, 4});
                const size_t asked = queries == Queries::every_state ? 8 : 3;
                const std::vector<float> noise = draws.normals<float>(2 * asked),
                                         coefficients = draws.normals<float>(asked);
                std::vector<float> moves(asked);
                for (size_t i = 0; i < asked; ++i) moves[i] = static_cast<float>(i % 2);
                const Build build = [&](Tape<double>& tape) {
                    const Policy<double> policy = forward(tape, model, batch, queries);
                    if (head == Head::deterministic)
                        return weighted_sum(tape, log_prob(tape, policy, batch.actions.data()), coefficients.data());
                    const bool gaussian = head == Head::squashed_gaussian;
                    const float* actions = gaussian ? batch.actions.data() : moves.data();
                    const Tensor<double> likelihood = log_prob(tape, policy, actions),
                                         entropy_of_each = entropy(tape, policy, noise.data());
                    return combine(tape, -1.0, weighted_sum(tape, likelihood, coefficients.data()), -0.3,
                                   weighted_sum(tape, entropy_of_each, coefficients.data()));
                };
                std::vector<Parameter<double>*> all;
                for (Parameter<double>& parameter : model.parameters) all.push_back(&parameter);
                gradients.check("transformer", build, all, 12);
            }
}

TEST(transformer_in_double_equals_a_plain_one) { check_against_plain<double>(1e-12); }

// Two layers of about ten operations in a row, sums of at most 32 products, and values that LayerNorm keeps near 1.
TEST(transformer_in_float_equals_a_plain_one_within_its_roundings) { check_against_plain<float>(20 * 32 * unit); }

TEST(attention_equals_attention_plain) {
    Draws draws = {13};
    constexpr int n = 7;
    for (const int d : {6, 19, 300}) {  // 300: columns by 128 or 64, by 16, and 12 more
        const size_t width = static_cast<size_t>(d), size = n * width;
        const std::vector<double> q = draws.normals<double>(size), k = draws.normals<double>(size),
                                  v = draws.normals<double>(size);
        std::vector<double> expected(size);
        attention_plain(expected.data(), q.data(), k.data(), v.data(), n, d);
        Tape<double> tape(serial());
        const Tensor<double> queries = tape.make(n, d), kv = tape.make(n, 2 * d);
        for (size_t i = 0; i < n; ++i)
            for (size_t c = 0; c < width; ++c) {
                queries.value[i * width + c] = q[i * width + c];
                kv.value[i * 2 * width + c] = k[i * width + c];
                kv.value[i * 2 * width + width + c] = v[i * width + c];
            }
        const Span span = {0, n, 0, n};
        const int position[n] = {0, 1, 2, 3, 4, 5, 6};
        const Tensor<double> out = attention(tape, queries, kv, d, &span, 1, position, 1, dropout_of(tape, 0));
        for (size_t i = 0; i < size; ++i) CHECK_CLOSE(out.value[i], expected[i], 1e-14);
    }
}

TEST(dot_adds_in_the_order_that_it_says_in_both_widths) {
    Draws draws = {16};
    for (size_t n = 0; n < 70; ++n) {
        const std::vector<float> x = draws.normals<float>(n), y = draws.normals<float>(n);
        float lane[16] = {}, rest = 0;
        for (size_t i = 0; i < n / 16 * 16; ++i) lane[i % 16] += x[i] * y[i];
        for (size_t i = n / 16 * 16; i < n; ++i) rest += x[i] * y[i];
        for (size_t width = 8; width > 0; width /= 2)
            for (size_t i = 0; i < width; ++i) lane[i] += lane[i + width];
        const float by_16 = dot<16>(x.data(), y.data(), static_cast<ptrdiff_t>(n));
        CHECK_EQUAL(by_16, lane[0] + rest);
        CHECK_EQUAL(dot(x.data(), y.data(), static_cast<ptrdiff_t>(n)), lane[0] + rest);
    }
}

TEST(softmax_of_attention_survives_huge_scores) {
    double x[3] = {1000, 0, 999};
    softmax(x, 3);
    CHECK_CLOSE(x[0], 1 / (1 + std::exp(-1.0)), 1e-15);
    CHECK_EQUAL(x[1], 0);
}

TEST(a_window_does_not_depend_on_its_neighbours_in_the_batch) {
    Draws draws = {14};
    for (const Kernel* kernel : kernels_of_this_machine()) {
        Compute compute(*kernel, 2);
        Transformer<float> model({state_dim, action_dim, 2, 2, 32, 5, 0.1f, Head::squashed_gaussian}, test_seed());
        scatter(model, draws);
        const SequenceBatch batch = random_batch(draws, {4, 1, 20, 3, 20});
        Tape<float> tape(compute);
        tape.recording = false;
        const Policy<float> together = forward(tape, model, batch, Queries::every_state);
        size_t first = 0;
        for (size_t w = 0; w < batch.lengths.size(); ++w) {
            const Policy<float> alone = forward(tape, model, window_of(batch, w), Queries::every_state);
            for (size_t i = 0; i < alone.output.size(); ++i) {
                CHECK_EQUAL(together.output.value[first + i], alone.output.value[i]);
                CHECK_EQUAL(together.log_std.value[first + i], alone.log_std.value[i]);
            }
            first += alone.output.size();
        }
    }
}

TEST(predictions_see_the_past_and_nothing_else) {
    Draws draws = {15};
    Transformer<float> model(tiny(Head::categorical, 0, 0), test_seed());
    scatter(model, draws);
    const SequenceBatch batch = random_batch(draws, {5});
    Tape<float> tape(serial());
    const std::vector<float> before = values(forward(tape, model, batch, Queries::every_state).output);
    // Which steps' predictions change when step c of an input does.
    const auto first_changed = [&](std::vector<float> SequenceBatch::*input, size_t c, size_t width) {
        SequenceBatch changed = batch;
        for (size_t j = 0; j < width; ++j) (changed.*input)[c * width + j] += 1;
        const std::vector<float> after = values(forward(tape, model, changed, Queries::every_state).output);
        size_t first = 0;
        while (first < 5 && before[first * action_dim] == after[first * action_dim] &&
               before[first * action_dim + 1] == after[first * action_dim + 1])
            ++first;
        return first;
    };
    for (size_t c = 0; c < 5; ++c) {
        CHECK_EQUAL(first_changed(&SequenceBatch::returns_to_go, c, 1), c);
        CHECK_EQUAL(first_changed(&SequenceBatch::states, c, state_dim), c);
        CHECK_EQUAL(first_changed(&SequenceBatch::actions, c, action_dim),
                    c + 1);  // of the last step: nowhere
    }
}

TEST(training_gives_the_same_bits_for_any_number_of_threads) {
    Draws draws = {16};
    Transformer<float> model({state_dim, action_dim, 2, 2, 32, 9, 0.1f, Head::squashed_gaussian}, test_seed());
    const SequenceBatch batch = random_batch(draws, std::vector<int>(24, 8));
    const std::vector<float> ones(static_cast<size_t>(batch.steps()), 1.0f);
    std::vector<std::vector<float>> first;
    for (const int threads : {1, 2, 5, 64}) {
        Compute compute(best_kernel(), threads == 64 ? 1 : threads);
        if (threads == 64) pretend(compute.threads, threads);
        Tape<float> tape(compute);
        for (Parameter<float>& parameter : model.parameters) parameter.gradient.assign(parameter.gradient.size(), 0);
        const Policy<float> policy = forward(tape, model, batch, Queries::every_state);
        tape.backward(weighted_sum(tape, gaussian_log_prob(tape, policy, batch.actions.data()), ones.data()));
        for (size_t p = 0; p < model.parameters.size(); ++p) {
            if (threads == 1) first.push_back(model.parameters[p].gradient);
            CHECK(same_bits(model.parameters[p].gradient, first[p]));
        }
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// Heads

namespace {

Tensor<double> filled(Tape<double>& tape, int rows, int columns, double value) {
    const Tensor<double> x = tape.make(rows, columns);
    std::fill_n(x.value, x.size(), value);
    return x;
}

}  // namespace

TEST(squashed_gaussian_is_a_density_with_the_closed_form) {
    Tape<double> tape(serial());
    constexpr int n = 20001;
    std::vector<float> a(n);
    for (int i = 0; i < n; ++i) a[static_cast<size_t>(i)] = static_cast<float>(std::tanh(14.0 * i / (n - 1) - 7));
    const double mean = 0.3, std = 0.8;
    const Policy<double> policy = {Head::squashed_gaussian, filled(tape, n, 1, mean),
                                   filled(tape, n, 1, std::log(std))};
    const Tensor<double> log_p = gaussian_log_prob(tape, policy, a.data());
    double integral = 0, entropy = 0, estimate = 0;
    for (size_t i = 0; i < n; ++i) {
        const double x = a[i], z = (std::atanh(x) - mean) / std;
        const double density = std::exp(-z * z / 2) / std / std::sqrt(2 * std::acos(-1)) / (1 - x * x);
        CHECK_CLOSE(log_p.value[i], std::log(density), 1e-9);
        if (i == 0) continue;
        const double p0 = std::exp(log_p.value[i - 1]), p1 = std::exp(log_p.value[i]), step = x - a[i - 1];
        integral += (p0 + p1) / 2 * step;
        entropy -= (p0 * log_p.value[i - 1] + p1 * log_p.value[i]) / 2 * step;
    }
    CHECK_CLOSE(integral, 1, 1e-5);
    // The one-sample estimate, averaged over its noise, is the entropy of that density.
    for (int i = 0; i < n; ++i) a[static_cast<size_t>(i)] = static_cast<float>(16.0 * i / (n - 1) - 8);
    const Tensor<double> sample = gaussian_entropy(tape, policy, a.data());
    for (size_t i = 0; i < n; ++i) {
        const double cosh = std::cosh(mean + std * a[i]), root_2_pi = std::sqrt(2 * std::acos(-1));
        CHECK_CLOSE(sample.value[i], 0.5 * a[i] * a[i] + std::log(std * root_2_pi) - 2 * std::log(cosh), 1e-12);
        estimate += std::exp(-0.5 * a[i] * a[i]) / root_2_pi * (16.0 / (n - 1)) * sample.value[i];
    }
    CHECK_CLOSE(estimate, entropy, 1e-5);
}

TEST(squashed_gaussian_is_finite_at_the_extremes) {
    Compute& compute = serial();
    for (const float mean : {-20.0f, 0.0f, 20.0f})
        for (const float log_std : {-5.0f, 2.0f})
            for (const float action : {-1 + 1e-6f, 1 - 1e-6f}) {
                Tape<float> tape(compute);
                const Policy<float> policy = {Head::squashed_gaussian, tape.make(1, 1), tape.make(1, 1)};
                policy.output.value[0] = mean;
                policy.log_std.value[0] = log_std;
                const float noise = action > 0 ? 5.8f : -5.8f;
                const Tensor<float> log_p = gaussian_log_prob(tape, policy, &action),
                                    entropy = gaussian_entropy(tape, policy, &noise);
                tape.backward(combine(tape, 1.0f, log_p, 1.0f, entropy));
                for (const float x : {log_p.value[0], entropy.value[0], *policy.output.grad(), *policy.log_std.grad()})
                    CHECK(std::isfinite(x));
            }
    CHECK_CLOSE(log_tanh_slope(50.0), 2 * (std::log(2.0) - 50), 1e-13);
    CHECK_CLOSE(log_tanh_slope(-50.0), 2 * (std::log(2.0) - 50), 1e-13);
    CHECK_EQUAL(softplus(1000.0), 1000);
    CHECK_EQUAL(softplus(-1000.0), 0);
}

TEST(categorical_head_is_exact_and_finite) {
    Tape<float> tape(serial());
    const float logits[] = {1, 2, 3, 4, 0, 100, 0, 0, 0, 0, -1000, 0, 7, 7, 7, 7}, moves[] = {3, 1, 2, 0};
    const Tensor<float> log_p = log_softmax(tape, tape.constant(logits, 4, 4)),
                        entropy = categorical_entropy(tape, log_p), chosen = categorical_log_prob(tape, log_p, moves);
    for (size_t row = 0; row < 4; ++row) {
        double total = 0, p_log_p = 0;
        for (size_t j = row * 4; j < row * 4 + 4; ++j) {
            CHECK(std::isfinite(log_p.value[j]));
            total += std::exp(log_p.value[j]);
            p_log_p += std::exp(static_cast<double>(log_p.value[j])) * log_p.value[j];
        }
        CHECK_CLOSE(total, 1, 8 * unit);
        CHECK_CLOSE(entropy.value[row], -p_log_p, 16 * unit);
        CHECK_EQUAL(chosen.value[row], log_p.value[row * 4 + static_cast<size_t>(moves[row])]);
    }
    CHECK_CLOSE(log_p.value[3], -std::log(1 + std::exp(-1.0) + std::exp(-2.0) + std::exp(-3.0)), 8 * unit);
    CHECK_EQUAL(log_p.value[10], -1000 - std::log(3.0f));
    CHECK_CLOSE(entropy.value[3], std::log(4.0), 8 * unit);
}

TEST(losses_equal_their_formulas) {
    Tape<double> tape(serial());
    const float prediction[] = {1, 2, 3, 4, 5, 6}, actions[] = {0, 0, 0, 1, 1, 1}, coefficients[] = {2, -1};
    const Tensor<double> error = squared_error(tape, tape.constant(prediction, 2, 3), actions);
    CHECK_CLOSE(error.value[0], 14.0 / 3, 1e-14);
    CHECK_CLOSE(error.value[1], 50.0 / 3, 1e-14);
    const Tensor<double> sum = weighted_sum(tape, error, coefficients);
    CHECK_CLOSE(sum.value[0], -22.0 / 3, 1e-14);
    CHECK_CLOSE(combine(tape, 3.0, sum, 0.5, sum).value[0], -3.5 * 22 / 3, 1e-13);
}

TEST(layer_norm_in_float_survives_a_large_mean) {
    Draws draws = {17};
    Tape<float> tape(serial());
    const Tensor<float> x = tape.make(1, 64), weight = tape.make(1, 64), bias = tape.make(1, 64);
    double mean = 0, variance = 0;
    for (int i = 0; i < 64; ++i) {
        x.value[i] = static_cast<float>(1000 + draws.normal());
        weight.value[i] = 1;
        bias.value[i] = 0;
        mean += x.value[i] / 64.0;
    }
    for (int i = 0; i < 64; ++i) variance += (x.value[i] - mean) * (x.value[i] - mean) / 64;
    const Tensor<float> y = layer_norm(tape, x, {weight, bias});
    for (int i = 0; i < 64; ++i)  // the mean's error, about 8 roundings of 1000, moves every element
        CHECK_CLOSE(y.value[i], (x.value[i] - mean) / std::sqrt(variance + 1e-5),
                    8 * 1000 * unit / std::sqrt(variance));
}

// ---------------------------------------------------------------------------------------------------------------------
// Initialisation

TEST(parameters_have_the_names_and_shapes_of_odt) {
    const Transformer<float> model({17, 6, 2, 4, 64, 1000, 0.1f, Head::squashed_gaussian}, 1);
    std::string got;
    for (const Parameter<float>& parameter : model.parameters) {
        got += parameter.name;
        uint64_t size = 1;
        for (const uint64_t extent : parameter.shape) {
            got += " " + std::to_string(extent);
            size *= extent;
        }
        got += "\n";
        CHECK_EQUAL(parameter.value.size(), size);
        CHECK_EQUAL(parameter.gradient.size(), size);
    }
    std::string expected =
        "embed_return.weight 64 1\nembed_return.bias "
        "64\nembed_state.weight 64 17\nembed_state.bias 64\n"
        "embed_action.weight 64 6\nembed_action.bias "
        "64\n"
        "embed_ln.weight 64\nembed_ln.bias 64\n";
    for (const std::string layer : {"0", "1"})
        for (const std::string name :
             {"ln_1.weight 64", "ln_1.bias 64", "attn.c_attn.weight 64 192", "attn.c_attn.bias 192",
              "attn.c_proj.weight 64 64", "attn.c_proj.bias 64", "ln_2.weight 64", "ln_2.bias 64",
              "mlp.c_fc.weight 64 256", "mlp.c_fc.bias 256", "mlp.c_proj.weight 256 64", "mlp.c_proj.bias 64"})
            expected += "transformer.h." + layer + "." + name + "\n";
    expected +=
        "transformer.ln_f.weight 64\ntransformer.ln_f.bias "
        "64\npredict_action.mu.weight 6 64\npredict_action.mu.bias 6\n"
        "predict_action.log_std.weight 6 64\npredict_action.log_std.bias 6\nembed_ordering.weight 1000 64\n";
    CHECK_EQUAL(got, expected);
    const Transformer<float> bare({17, 6, 1, 1, 64, 0, 0, Head::categorical}, 1);
    for (const Parameter<float>& parameter : bare.parameters) CHECK(parameter.name != "embed_ordering.weight");
    CHECK_FAILS("nn.config", Transformer<float>({17, 6, 2, 3, 64, 0, 0, Head::categorical}, 1));
    CHECK_FAILS("nn.config", Transformer<float>({17, 0, 2, 4, 64, 0, 0, Head::categorical}, 1));
    CHECK_FAILS("nn.config", Transformer<float>({17, 65, 2, 4, 64, 0, 0, Head::categorical}, 1));
    CHECK_FAILS("nn.config", Transformer<float>({17, 6, 2, 4, 64, 0, 1, Head::categorical}, 1));
}

TEST(parameters_start_as_odt_starts_them) {
    const TransformerConfig config = {17, 6, 1, 4, 64, 500, 0.1f, Head::squashed_gaussian};
    const Transformer<float> model(config, test_seed()), again(config, test_seed()), other(config, test_seed() + 1);
    const Transformer<double> in_double(config, test_seed());
    for (size_t p = 0; p < model.parameters.size(); ++p) {
        const Parameter<float>& parameter = model.parameters[p];
        const std::string& name = parameter.name;
        const auto has = [&](const char* part) { return name.find(part) != std::string::npos; };
        const size_t n = parameter.value.size();
        CHECK(same_bits(parameter.value, again.parameters[p].value));
        double mean = 0, square = 0, largest = 0;
        for (size_t i = 0; i < n; ++i) {
            CHECK_EQUAL(parameter.value[i], static_cast<float>(in_double.parameters[p].value[i]));
            mean += parameter.value[i] / static_cast<double>(n);
            square += static_cast<double>(parameter.value[i]) * parameter.value[i] / static_cast<double>(n);
            largest = std::max(largest, std::fabs(static_cast<double>(parameter.value[i])));
        }
        const double five_sigma = 5 / std::sqrt(static_cast<double>(n));
        if (has("embed_") && !has("_ln") && !has("ordering")) {
            const double bound = 1 / std::sqrt(has("return") ? 1.0 : has("state") ? 17.0 : 6.0);
            CHECK(largest <= bound && largest > 0.8 * bound);
            CHECK_CLOSE(mean, 0, five_sigma * bound / std::sqrt(3));
            CHECK_CLOSE(square, bound * bound / 3, five_sigma * bound * bound * std::sqrt(4.0 / 45));
        } else if (has("ln_") || has("_ln")) {
            for (const float value : parameter.value) CHECK_EQUAL(value, has("weight") ? 1.0f : 0.0f);
        } else if (has(".bias")) {
            CHECK_EQUAL(largest, 0);
        } else if (has("predict_action")) {
            for (size_t i = 0; i < 6; ++i)
                for (size_t j = 0; j <= i; ++j) {
                    double along = 0;
                    for (size_t c = 0; c < 64; ++c)
                        along += static_cast<double>(parameter.value[i * 64 + c]) * parameter.value[j * 64 + c];
                    CHECK_CLOSE(along, i == j, 1e-6);
                }
        } else {
            const double deviation = has("ordering") ? 1 : 0.02;
            CHECK_CLOSE(mean, 0, five_sigma * deviation);
            CHECK_CLOSE(square, deviation * deviation, five_sigma * deviation * deviation * std::sqrt(2));
        }
        const bool drawn = largest > 0 && !has("ln_") && !has("_ln");
        CHECK_EQUAL(same_bits(parameter.value, other.parameters[p].value), !drawn);
        if (p > 0 && drawn) CHECK(parameter.value[0] != model.parameters[p - 1].value[0]);
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// Optimisers

namespace {

using Rule = OptimizerConfig::Rule;

std::vector<Parameter<float>> some_parameters(Draws& draws) {
    std::vector<Parameter<float>> parameters;
    for (const size_t n : {9001u, 7u, 1u, 6u, 3u}) {
        parameters.push_back({"tensor" + std::to_string(n), {n}, draws.normals<float>(n), std::vector<float>(n)});
        if (n == 6) parameters.back().value.assign(n, 0);  // starts at zero; tensor3 never gets a gradient
    }
    return parameters;
}

void draw_gradients(Draws& draws, std::vector<Parameter<float>>& parameters, double scale) {
    for (Parameter<float>& parameter : parameters)
        if (parameter.name != "tensor3") parameter.gradient = draws.normals<float>(parameter.gradient.size(), scale);
}

// LAMB as ODT has it and AdamW as PyTorch has it, in double.
struct PlainOptimizer {
    std::vector<std::vector<double>> value, m, v;
    int t = 0;

    explicit PlainOptimizer(const std::vector<Parameter<float>>& parameters) {
        for (const Parameter<float>& parameter : parameters)
            value.emplace_back(parameter.value.begin(), parameter.value.end());
        m = v = value;
        for (size_t p = 0; p < value.size(); ++p) m[p].assign(value[p].size(), 0), v[p].assign(value[p].size(), 0);
    }
    static double norm(const std::vector<double>& x) {
        double squares = 0;
        for (const double e : x) squares += e * e;
        return std::sqrt(squares);
    }
    // Returns the norm of the gradient.
    double step(const std::vector<Parameter<float>>& parameters, const OptimizerConfig& c) {
        std::vector<double> all;
        for (const Parameter<float>& parameter : parameters)
            all.insert(all.end(), parameter.gradient.begin(), parameter.gradient.end());
        const double clip = c.clip_norm > 0 ? std::min(1.0, c.clip_norm / (norm(all) + 1e-6)) : 1;
        const double warmup = static_cast<double>(c.warmup_updates);
        const double rate = c.learning_rate * (warmup > 0 ? std::min((t + 1) / warmup, 1.0) : 1);
        ++t;
        for (size_t p = 0; p < value.size(); ++p) {
            std::vector<double> u(value[p].size());
            for (size_t i = 0; i < u.size(); ++i) {
                const double g = clip * parameters[p].gradient[i];
                m[p][i] = c.beta1 * m[p][i] + (1 - c.beta1) * g;
                v[p][i] = c.beta2 * v[p][i] + (1 - c.beta2) * g * g;
                const double m_hat = m[p][i] / (1 - std::pow(c.beta1, t)), v_hat = v[p][i] / (1 - std::pow(c.beta2, t));
                u[i] = m_hat / (std::sqrt(v_hat) + c.epsilon);
                if (c.rule == Rule::lamb) u[i] += c.weight_decay * value[p][i];
            }
            double trust = 1;
            if (c.rule == Rule::lamb && (c.weight_decay != 0 || c.always_adapt) && norm(value[p]) > 0 && norm(u) > 0)
                trust = norm(value[p]) / norm(u);
            for (size_t i = 0; i < u.size(); ++i) {
                if (c.rule == Rule::adamw) value[p][i] -= rate * c.weight_decay * value[p][i];
                value[p][i] -= rate * trust * u[i];
            }
        }
        return norm(all);
    }
};

// before: how many updates count as made, with moments of 0.
void check_optimizer(const OptimizerConfig& config, double gradient_scale, int before = 0) {
    Draws draws = {18};
    std::vector<Parameter<float>> parameters = some_parameters(draws);
    PlainOptimizer plain(parameters);
    plain.t = before;
    Optimizer optimizer;
    optimizer.updates = static_cast<uint64_t>(before);
    for (int step = 1; step <= 8; ++step) {
        draw_gradients(draws, parameters, gradient_scale);
        const double norm = plain.step(parameters, config);
        CHECK_CLOSE(update_parameters(serial(), parameters, optimizer, config), norm, 1e-12 * norm);
        CHECK_EQUAL(optimizer.updates, static_cast<uint64_t>(before + step));
        for (size_t p = 0; p < parameters.size(); ++p)
            for (size_t i = 0; i < parameters[p].value.size(); ++i) {
                // A moment: 4 roundings a step, of numbers below 6 scales. A value: 2 of itself, and those of u, below
                // 10, times the rate, which the trust ratio can make 10 times as large.
                CHECK_CLOSE(optimizer.first_moment[p][i], plain.m[p][i], 4 * step * unit * gradient_scale);
                CHECK_CLOSE(optimizer.second_moment[p][i], plain.v[p][i],
                            4 * step * unit * gradient_scale * gradient_scale);
                CHECK_CLOSE(parameters[p].value[i], plain.value[p][i],
                            step * unit * (2 * std::fabs(plain.value[p][i]) + 100 * config.learning_rate));
                CHECK_EQUAL(parameters[p].gradient[i], 0.0f);
            }
    }
}

}  // namespace

TEST(optimizers_equal_plain_ones_in_double) {
    for (const double epsilon : {1e-8, 0.1})               // the large one shows where epsilon goes
        for (const double gradient_scale : {1e-4, 0.5}) {  // clipping does nothing, or a lot
            OptimizerConfig config = {Rule::lamb, 1e-2, 0.9, 0.999, epsilon, 0, false, 0.25, 4};
            check_optimizer(config, gradient_scale);  // no decay: no trust ratio
            config.always_adapt = true;
            check_optimizer(config, gradient_scale);
            config.always_adapt = false;
            config.weight_decay = 0.02;
            check_optimizer(config, gradient_scale);
            config.rule = Rule::adamw;
            check_optimizer(config, gradient_scale);
            config.weight_decay = 0;  // Adam
            config.clip_norm = 0;
            config.warmup_updates = 0;
            check_optimizer(config, gradient_scale);
            for (const int before : {400, 16624})  // the second bias correction is near 1, and becomes 1
                check_optimizer(config, gradient_scale, before);
        }
}

TEST(warmup_rises_by_equal_steps_to_one) {
    CHECK_EQUAL(warmup_factor(0, 10000), 1e-4);
    CHECK_EQUAL(warmup_factor(4998, 10000), 0.4999);
    CHECK_EQUAL(warmup_factor(9999, 10000), 1);
    CHECK_EQUAL(warmup_factor(1000000, 10000), 1);
    CHECK_EQUAL(warmup_factor(0, 0), 1);
    CHECK_EQUAL(warmup_factor(0, 1), 1);
}

TEST(clipping_starts_where_the_norm_and_1e_6_reach_the_limit) {
    for (const float norm : {0.249998f, 0.25f, 2.5f}) {
        std::vector<Parameter<float>> one = {{"x", {1}, {1.0f}, {norm}}};
        Optimizer optimizer;
        CHECK_EQUAL(update_parameters(serial(), one, optimizer, {}), static_cast<double>(norm));
        const double clipped = norm < 0.25f ? static_cast<double>(norm) : norm * (0.25 / (norm + 1e-6));
        CHECK_CLOSE(optimizer.first_moment[0][0], 0.1 * clipped, 0.1 * clipped * 3 * unit);
    }
}

TEST(numbers_that_are_not_finite_are_named_and_a_bad_gradient_changes_nothing) {
    for (const float bad : {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity()}) {
        Draws draws = {19};
        std::vector<Parameter<float>> parameters = some_parameters(draws), before = parameters;
        Optimizer optimizer;
        draw_gradients(draws, parameters, 1);
        parameters[0].gradient[5000] = bad;
        const std::string message = failure([&] { update_parameters(serial(), parameters, optimizer, {}); });
        CHECK(message.find("nn.not_finite: ") == 0 && message.find("tensor9001") != std::string::npos);
        CHECK_EQUAL(optimizer.updates, 0u);
        for (size_t p = 0; p < parameters.size(); ++p) CHECK(same_bits(parameters[p].value, before[p].value));
        parameters[0].gradient[5000] = 0;
        parameters[1].value[6] = bad;
        const std::string later = failure([&] { update_parameters(serial(), parameters, optimizer, {}); });
        CHECK(later.find("nn.not_finite: ") == 0 && later.find("tensor7") != std::string::npos);
    }
}

TEST(updates_give_the_same_bits_for_any_number_of_threads) {
    std::vector<Parameter<float>> first;
    for (int threads = 1; threads <= 8; ++threads) {
        Draws draws = {21};
        Compute compute(kernel_portable, threads);
        std::vector<Parameter<float>> parameters = some_parameters(draws);
        Optimizer optimizer;
        OptimizerConfig config;
        config.weight_decay = 0.01;
        config.warmup_updates = 1;
        for (int step = 0; step < 3; ++step) {
            draw_gradients(draws, parameters, 1);
            update_parameters(compute, parameters, optimizer, config);
        }
        if (threads == 1) first = parameters;
        for (size_t p = 0; p < first.size(); ++p) CHECK(same_bits(parameters[p].value, first[p].value));
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// Dropout and memory

TEST(dropout_keeps_its_share_and_scales_it_up) {
    Tape<double> tape(serial());
    tape.dropout_random.seed = test_seed();
    constexpr int n = 40000;
    const std::vector<double> ones(n, 1);
    const auto mask = [&](uint32_t site, float p) {
        const Tensor<double> x = tape.constant(ones.data(), n / 8, 8);
        return values(dropout_add(tape, x, dropout_at(tape, site, p)));
    };
    const std::vector<double> first = mask(3, 0.1f);
    const double keep = 1 / (1 - static_cast<double>(0.1f));
    int kept = 0;
    for (const double factor : first) {
        CHECK(factor == 0 || factor == keep);
        kept += factor != 0;
    }
    CHECK_CLOSE(kept, 0.9 * n, 5 * std::sqrt(n * 0.9 * 0.1));
    // The same counter gives the same mask; another site or update an independent one: both agree 0.82 n times.
    CHECK(same_bits(mask(3, 0.1f), first));
    const auto agreement = [&](const std::vector<double>& other) {
        int same = 0;
        for (size_t i = 0; i < n; ++i) same += other[i] == first[i];
        return same;
    };
    CHECK_CLOSE(agreement(mask(4, 0.1f)), 0.82 * n, 5 * std::sqrt(n * 0.82 * 0.18));
    tape.dropout_step = 1;
    CHECK_CLOSE(agreement(mask(3, 0.1f)), 0.82 * n, 5 * std::sqrt(n * 0.82 * 0.18));
    tape.recording = false;
    CHECK(same_bits(mask(3, 0.1f), std::vector<double>(n, 1)));
}

TEST(dropout_in_pieces_equals_dropout_of_the_whole) {
    const Dropout dropout = {{test_seed(), Stream::dropout}, 1, 2, 0.5f};
    const size_t n = 700;  // more than a chunk
    std::vector<uint8_t> kept(n), filled(n);
    dropout.fill(kept.data(), 0, n);
    for (size_t begin = 0; begin < n; begin += 7) dropout.fill(&filled[begin], begin, std::min(n - begin, size_t{7}));
    CHECK(filled == kept);
    Compute two(kernel_portable, 2);
    Tape<double> tape(two);
    const std::vector<double> threes(n * 8, 3);
    kept.resize(n * 8);
    dropout.fill(kept.data(), 0, n * 8);
    const Tensor<double> x = tape.constant(threes.data(), n, 8);
    std::vector<double> expected;
    for (const uint8_t one : kept) expected.push_back(one * 2.0 * 3.0);
    CHECK(same_bits(values(dropout_add(tape, x, dropout)), expected));
}

TEST(dropout_places_of_a_network_are_all_different) {
    std::vector<bool> taken(13);
    taken[0] = true;  // after the embedding
    for (int layer = 0; layer < 4; ++layer)
        for (int place = 0; place < 3; ++place) {
            CHECK(!taken[dropout_site(layer, place)]);
            taken[dropout_site(layer, place)] = true;
        }
}

TEST(arena_serves_later_passes_from_the_memory_of_the_first) {
    Arena arena;
    std::vector<std::vector<void*>> passes(4);
    for (std::vector<void*>& pass : passes) {
        for (const size_t bytes : {1u, 64u, 65u, 3000000u, 100u, 900000u, 0u, 900000u}) {
            pass.push_back(arena.take(bytes));
            CHECK_EQUAL(reinterpret_cast<uintptr_t>(pass.back()) % 64, 0u);
            std::memset(pass.back(), 1, bytes);
        }
        for (size_t i = 1; i < pass.size(); ++i) CHECK(pass[i] != pass[i - 1] || i == 7);  // of no bytes
        arena.reset();
    }
    CHECK(passes[3] == passes[2]);
}

TEST(arena_lies_in_one_piece_however_the_shapes_vary) {  // or it would grow with every new shape
    Arena arena;
    size_t largest = 0;
    for (const size_t extra : {0u, 30u, 10u, 90u, 20u, 0u}) {
        const size_t bytes = 2000000 + extra * 64;
        char* end = nullptr;
        for (int i = 0; i < 10; ++i) {
            char* piece = static_cast<char*>(arena.take(bytes));
            if (i > 0 && bytes < largest) CHECK(piece == end);
            end = piece + bytes;
        }
        largest = std::max(largest, bytes);
        arena.reset();
    }
}
