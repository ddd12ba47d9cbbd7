// bench.hpp: what `wodtem bench` measures, all in one run, so that ratios mean something: the machine's peaks first,
// then each kernel's share of them at the shapes that training uses, the update of both networks with the best
// kernel, look-ups, acting. Medians and ranges; a machine's clock moves with its neighbours, so figures of different
// runs do not compare.
// Included by wodtem.cpp, after training. Leaves out: judging; a test never looks at a clock.
#pragma once

#include <sys/resource.h>

#include "memory_bytes.hpp"

double seconds_of(const std::function<void()>& work) {
    const Clock::time_point begin = Clock::now();
    work();
    return seconds_since(begin);
}

struct Spread {
    double low = 0, median = 0, high = 0;
};

Spread spread_of(std::vector<double> values) {
    std::sort(values.begin(), values.end());
    return {values.front(), values[values.size() / 2], values.back()};
}

// Percent that the least seconds are of those measured.
Spread share_of(double least, const Spread& seconds) {
    return {100 * least / seconds.high, 100 * least / seconds.median, 100 * least / seconds.low};
}

// Seconds of `rounds` runs, after one that does not count.
Spread timed(int rounds, const std::function<void()>& work) {
    work();
    std::vector<double> seconds;
    for (int round = 0; round < rounds; ++round) seconds.push_back(seconds_of(work));
    return spread_of(seconds);
}

// One measurement. The counts are what the task cannot do without; a share of a peak is of the peak of its own moment.
struct Measurement {
    std::string group, name;
    Spread seconds;                    // of one
    double operations = 0, bytes = 0;  // 2 a multiply-add; between core and memory; 0: not counted
    Spread share = {};                 // of the peak, in percent; 0: not compared
};

struct Measurements {
    bool json;
    std::vector<Measurement> all;

    void add(Measurement one) {
        if (!json) print(one, all.empty() || all.back().group != one.group);
        all.push_back(std::move(one));
    }

    static void print(const Measurement& f, bool first) {
        if (first) std::printf("%s\n", f.group.c_str());
        const double s = f.seconds.median, unit = s < 1e-4 ? 1e6 : s < 1 ? 1e3 : 1;
        std::printf("  %-44s %8.3f %s (%.3f to %.3f)", f.name.c_str(), s * unit,
                    unit > 1e3 ? "us"
                    : unit > 1 ? "ms"
                               : "s ",
                    f.seconds.low * unit, f.seconds.high * unit);
        if (f.operations > 0) std::printf("  %7.1f GFLOP/s", f.operations / s / 1e9);
        if (f.bytes > 0) std::printf("  %6.1f GB/s", f.bytes / s / 1e9);
        if (f.share.median > 0) std::printf("  %3.0f%% (%.0f to %.0f)", f.share.median, f.share.low, f.share.high);
        std::printf("\n");
        std::fflush(stdout);
    }

    void print_json() const {
        const auto text = [](const Spread& x) {
            return "[" + number_text(x.low) + ", " + number_text(x.median) + ", " + number_text(x.high) + "]";
        };
        std::printf("[");
        for (const Measurement& f : all)
            std::printf(
                "%s\n  {\"group\": \"%s\", \"name\": \"%s\", \"seconds\": %s, \"operations\": %s, \"bytes\": %s, "
                "\"share_percent\": %s}",
                &f == &all[0] ? "" : ",", f.group.c_str(), f.name.c_str(), text(f.seconds).c_str(),
                number_text(f.operations).c_str(), number_text(f.bytes).c_str(), text(f.share).c_str());
        std::printf("\n]\n");
    }
};

// ---------------------------------------------------------------------------------------------------------------------
// Peaks: arithmetic in registers alone, and memory read from end to end.

#pragma GCC push_options
#pragma GCC optimize("O2")  // at the level of what is around it the sums would not stay in registers

constexpr int burn_chains = 12;  // independent sums in flight: latency 4, two units, and some to spare

template <class V, Multiply How>
ALWAYS_INLINE float burn_vectors(int64_t rounds) {
    V sum[burn_chains], a = 0.999f - V{}, b = 0.001f - V{};
#pragma GCC unroll 16
    for (int i = 0; i < burn_chains; ++i) sum[i] = V{};
    for (int64_t round = 0; round < rounds; ++round) {
#pragma GCC unroll 16
        for (int i = 0; i < burn_chains; ++i) {
            if constexpr (How == Multiply::plain)
                sum[i] = sum[i] * a + b;
            else
                multiply_add<How>(sum[i], a, b);
        }
#if defined(__x86_64__)
        asm volatile("" : "+v"(a));  // a might have changed: no product may leave the loop
#endif
    }
    V total = sum[0];
#pragma GCC unroll 16
    for (int i = 1; i < burn_chains; ++i) total += sum[i];
    return total[0];
}

#ifdef X86_KERNELS
__attribute__((target("avx512f"))) float burn_avx512(int64_t rounds) {
    return burn_vectors<Vector<float, 16>, Multiply::fused>(rounds);
}
__attribute__((target("avx2,fma"))) float burn_avx2(int64_t rounds) {
    return burn_vectors<Vector<float, 8>, Multiply::fused>(rounds);
}
__attribute__((target("arch=x86-64-v4,avx512bf16"))) float burn_bf16(int64_t rounds) {
    return burn_vectors<Vector<float, 16>, Multiply::bf16>(rounds);
}
#endif

// Operations a second of one core in the kernel's own instructions.
double burn_rate(const Kernel& kernel) {
    float (*burn)(int64_t) = burn_vectors<Vector<float, 4>, Multiply::plain>;
    if (&kernel == &kernel_portable_bf16) burn = burn_vectors<Vector<float, 4>, Multiply::bf16_portable>;
    const double operations = 2.0 * burn_chains * kernel.tile_columns / 2 * k_a_word(kernel.how);
#ifdef X86_KERNELS
    if (&kernel == &kernel_avx512) burn = burn_avx512;
    if (&kernel == &kernel_avx2) burn = burn_avx2;
    if (&kernel == &kernel_avx512_bf16) burn = burn_bf16;
#endif
    volatile float sink = 0;
    const double rounds = std::max(1.0, 3e8 / operations);
    const double seconds = seconds_of([&] { sink = sink + burn(static_cast<int64_t>(rounds)); });
    return operations * rounds / seconds;
}

std::string label(const Kernel& kernel) { return std::string(kernel.name) + " " + kernel.arithmetic(); }

float sum_of(const float* x, size_t n) {
    typedef float Lanes __attribute__((vector_size(256), aligned(4), may_alias));  // four vectors of 16 in flight
    Lanes sums = {};
    vectorised<float>([&](auto) INLINE_LAMBDA {
        for (size_t i = 0; i + 64 <= n; i += 64) sums += *reinterpret_cast<const Lanes*>(x + i);
    });
    float sum = 0;
    for (int i = 0; i < 64; ++i) sum += sums[i];
    return sum;
}

#pragma GCC pop_options

// Bytes a second that `threads` read from memory beyond any cache.
double bench_memory_bandwidth(Measurements& measured, int threads) {
    constexpr size_t count = size_t{1} << 26, tasks = 64;  // 256 MB
    const std::vector<float> x(count, 1.0f);
    Threads workers(threads);
    std::vector<float> sums(tasks);
    const Spread time = timed(5, [&] {
        workers.run(tasks, [&](int task, int) {
            sums[static_cast<size_t>(task)] = sum_of(&x[static_cast<size_t>(task) * (count / tasks)], count / tasks);
        });
    });
    const double bytes = static_cast<double>(count * sizeof(float));
    measured.add({"peaks", "memory read, " + std::to_string(threads) + " threads", time, 0, bytes});
    return bytes / time.median;
}

// ---------------------------------------------------------------------------------------------------------------------
// Kernels.

struct Shape2 {
    const char* what;
    int M, N, K;
    bool a_transposed, b_transposed;
};

// The shapes of the paper's grid-world network at batch 256, of a gym network's MLP on 2048 tokens, and of a small one.
constexpr Shape2 product_shapes[] = {
    {"keys, values", 512, 1024, 512, false, false},
    {"attention out", 256, 512, 512, false, false},
    {"MLP in", 256, 2048, 512, false, false},
    {"MLP out", 256, 512, 2048, false, false},
    {"MLP in, d input", 256, 512, 2048, false, true},
    {"MLP in, d weight", 512, 2048, 256, true, false},
    {"small MLP in", 256, 64, 16, false, false},
    {"gym MLP in", 2048, 2048, 512, false, false},
    {"gym MLP in, d input", 2048, 512, 2048, false, true},
    {"gym MLP in, d weight", 512, 2048, 2048, true, false},
};

// Returns the mean rate at the gym network's shapes, operations a second.
double bench_products(Measurements& measured, const Kernel& kernel, int threads) {
    Compute compute(kernel, threads);
    const std::string group =
        "products, " + label(kernel) + ", " + std::to_string(threads) + " threads; share of the peak";
    double gym_operations = 0, gym_seconds = 0;
    for (const Shape2& s : product_shapes) {
        const auto size = [](int rows, int columns) {
            return static_cast<size_t>(rows) * static_cast<size_t>(columns);
        };
        const std::vector<float> a(size(s.M, s.K), 0.5f), b(size(s.K, s.N), 0.25f);
        std::vector<float> c(size(s.M, s.N));
        const double operations = 2.0 * s.M * s.N * s.K;
        const int repeats = std::max(1, static_cast<int>(5e8 / operations));
        const auto multiply = [&] {
            for (int i = 0; i < repeats; ++i)
                matmul(compute, View<float>{c.data(), s.N}, {a.data(), s.a_transposed ? s.M : s.K, s.a_transposed},
                       {b.data(), s.b_transposed ? s.K : s.N, s.b_transposed}, s.M, s.N, s.K, Store::overwrite);
        };
        multiply();
        std::vector<double> seconds, shares;  // each beside the peak of its own moment: neighbours come and go
        for (int round = 0; round < 9; ++round) {
            const double before = burn_rate(kernel), time = seconds_of(multiply) / repeats;
            seconds.push_back(time);
            shares.push_back(100 * operations / time / threads / std::max(before, burn_rate(kernel)));
        }
        char name[80];
        std::snprintf(name, sizeof name, "%-20s %5d x %4d x %4d", s.what, s.M, s.N, s.K);
        measured.add({group, name, spread_of(seconds), operations, 0, spread_of(shares)});
        if (std::string(s.what).starts_with("gym")) {
            gym_operations += operations;
            gym_seconds += spread_of(seconds).median;
        }
    }
    return gym_operations / gym_seconds;
}

// What else an update of the gym network does, on a part of 2048 tokens; the optimiser on all its weights. Share of the
// memory's speed.
void bench_other_kernels(Measurements& measured, const Kernel& kernel, int threads, double bandwidth) {
    Compute compute(kernel, threads);
    Tape<float> tape(compute);
    constexpr int tokens = 59 * 34, d = 512, windows = 34;
    const std::string group = "other kernels, " + std::to_string(threads) + " threads; share of the memory's speed";
    const double row_bytes = 4.0 * tokens * d;
    const auto add = [&](const char* name, const Spread& time, double operations, double bytes) {
        measured.add({group, name, time, operations, bytes, share_of(bytes / bandwidth, time)});
    };
    Parameter<float> weight{"", {d}, std::vector<float>(d, 1.0f), std::vector<float>(d)}, bias = weight;
    std::vector<float> values(static_cast<size_t>(tokens) * d * 3, 0.5f), gradients(values.size());
    Gradient<float> gradient = {gradients.data()};
    const auto tensor = [&](int columns) { return Tensor<float>{values.data(), &gradient, tokens, columns}; };
    const std::vector<float> coefficients(tokens, 1.0f);
    Tensor<float> y;
    const auto backward = [&] {
        std::fill_n(gradient_of(y), y.size(), 1e-3f);
        const Tensor<float> one = tape.make(1, 1);
        tape.backward(one);
    };
    const Spread norm = timed(9, [&] {
        tape.reset();
        y = layer_norm(tape, tensor(d), {weight.tensor(), bias.tensor()});
        backward();
    });
    add("LayerNorm, forward and backward", norm, 0, 7 * row_bytes);  // x, y; dy, x, dx twice, y
    std::vector<Span> spans;
    std::vector<int> position;
    for (int i = 0; i < windows; ++i) spans.push_back({59 * i, 59, 59 * i, 59});
    for (int i = 0; i < tokens; ++i) position.push_back(i);
    const Spread attend = timed(9, [&] {
        tape.reset();
        const Tensor<float> qkv = tensor(3 * d);
        y = attention(tape, qkv, qkv, d, spans.data(), windows, position.data(), 4, dropout_at(tape, 0, 0.1f));
        backward();
    });
    add("attention, 4 heads, forward and backward", attend, 7 * 2.0 * tokens * 30 * d, 11 * row_bytes);
    std::vector<Parameter<float>> parameters(1);
    parameters[0] = {"", {4096, 3072}, std::vector<float>(4096 * 3072, 0.01f), std::vector<float>(4096 * 3072, 1e-3f)};
    Optimizer optimizer;
    OptimizerConfig config;
    config.weight_decay = 5e-4;
    const Spread step = timed(5, [&] { update_parameters(compute, parameters, optimizer, config); });
    add("LAMB, 12.6 million weights", step, 0, 4.0 * 4096 * 3072 * 8);  // read g, m, v, x; write m, v, x, g
}

// Arithmetic of one update that the action prediction needs (2 a multiply-add; forward, and twice that backward), with
// whole windows of C steps: 3C - 1 tokens in every layer but the last, which needs keys and values of all tokens and
// the rest for the C state tokens; attention sees half of the tokens on average.
double update_flops(const Settings& settings) {
    const double d = static_cast<double>(settings.width), C = static_cast<double>(settings.context_length);
    const double tokens = 3 * C - 1, whole_layer = tokens * (12 * d * d + tokens * d),
                 last_layer = tokens * 2 * d * d + C * (10 * d * d + tokens * d);
    return 6 * static_cast<double>(settings.batch_size) *
           (static_cast<double>(settings.layers - 1) * whole_layer + last_layer);
}

// What the machine has just shown that it can do: operations a second of products at the gym network's shapes, bytes a
// second from memory.
struct Rates {
    double products, memory;
};

// The network's part of a step, at full windows. It needs the operations of update_flops' forward pass, the last layer
// asked for one token alone, and all weights once from memory; its share is of whichever of the two takes longer.
void bench_acting(Measurements& measured, Run& run, size_t episodes, const Rates& rates) {
    std::vector<Episode> playing(episodes);
    std::vector<Episode*> running;
    for (Episode& episode : playing) {
        episode.trajectory = run.replay.trajectories[0];
        episode.targets.assign(episode.trajectory.rewards.size() + 1, 1.0f);
        episode.state.assign(run.agent.spec.state_dim, 0.0f);
        running.push_back(&episode);
    }
    const SequenceBatch batch = acting_batch(run.agent, running);
    const FrozenWeights frozen(run.compute);
    const Spread time = timed(9, [&] {
        run.acting.reset();
        forward(run.acting, run.agent.model, batch, Queries::last_state);
    });
    const Kernel& kernel = run.compute.kernel;
    const double d = static_cast<double>(run.agent.settings.width), tokens = 3.0 * batch.lengths[0] - 1,
                 layers = static_cast<double>(run.agent.settings.layers);
    const double operations = 2 * static_cast<double>(episodes) *
                              ((layers - 1) * tokens * (12 * d * d + tokens * d) + tokens * 2 * d * d + 10 * d * d),
                 bytes = 12 * layers * d * d * 4.0 / k_a_word(kernel.how);
    measured.add({"acting, one step of the gym network, windows of " + std::to_string(batch.lengths[0]) +
                      "; share of the products' own rate or the memory's speed",
                  std::to_string(episodes) + " episodes, " + label(kernel), time, operations, bytes,
                  share_of(std::max(operations / rates.products, bytes / rates.memory), time)});
}

void bench_update(Measurements& measured, const Kernel& kernel, int threads, const Rates& rates, const char* what,
                  const Settings& settings) {
    Compute compute(kernel, threads);
    Run run(compute, settings, *make_environment(settings));
    begin_run(run, make_data_set(settings));
    const double operations = update_flops(settings);
    const int repeats = std::max(1, static_cast<int>(1e9 / operations));
    std::vector<double> seconds, shares;
    update(run);
    for (int round = 0; round < (operations > 1e11 ? 2 : 7); ++round) {
        seconds.push_back(seconds_of([&] {
                              for (int i = 0; i < repeats; ++i) update(run);
                          }) /
                          repeats);
        shares.push_back(100 * operations / seconds.back() / rates.products);
    }
    measured.add({"updates; share of the products' own rate at the gym network's shapes",
                  std::string(what) + ", " + label(kernel) + ", " + std::to_string(threads) + " threads",
                  spread_of(seconds), operations, 0, spread_of(shares)});
    if (settings.context_length == 1) return;
    for (const size_t episodes : {size_t{1}, size_t{10}}) bench_acting(measured, run, episodes, rates);
}

// Seconds that `threads` take for the job: each takes the next task as soon as it is free.
double shared_seconds(const std::vector<double>& tasks, int threads) {
    std::vector<double> busy_until(static_cast<size_t>(threads));
    for (const double seconds : tasks) *std::ranges::min_element(busy_until) += seconds;
    return std::ranges::max(busy_until);
}

// Seconds of one update; those in tasks that threads would share, on one core and dealt out; jobs that these make.
struct Forecast {
    double alone = 0, in_tasks = 0, shared = INFINITY;
    size_t jobs = 0;
};

Forecast rehearse(Run& run, int cores) {
    Forecast forecast = {0, 0, 0, 0};
    Threads& threads = run.compute.threads;
    threads.pretended = cores;
    threads.rehearse = [&](int tasks, const std::function<void(int, int)>& f) {
        std::vector<double> seconds;
        for (int task = 0; task < tasks; ++task) seconds.push_back(seconds_of([&] { f(task, 0); }));
        forecast.in_tasks += std::accumulate(seconds.begin(), seconds.end(), 0.0);
        forecast.shared += shared_seconds(seconds, cores);
        ++forecast.jobs;
    };
    forecast.alone = seconds_of([&] { update(run); }) - forecast.in_tasks;
    threads.pretended = 0, threads.rehearse = nullptr;
    return forecast;
}

#ifdef WODTEM_MUJOCO

// The gym network, on episodes that fill whole windows.
Settings gym_settings() {
    Settings settings = default_settings("halfcheetah-v2", "wodtem", "paper");
    set_setting(settings, "behaviour", "random");
    return settings;
}

// What an update of an eighth of the gym network's batch would take on more cores than there are: its work is cut as
// for so many threads, each task timed alone, and each job's tasks dealt out. A job also costs what a job of nothing
// costs two threads here. Left out: cores share caches and memory. The better of two: a neighbour may have the core.
void bench_many_cores(Measurements& measured, const Kernel& kernel) {
    Settings settings = gym_settings();
    settings.batch_size /= 8;
    Threads two(2);
    const double meeting = timed(1001, [&] { two.run(2, [](int, int) {}); }).median;
    Compute compute(kernel, 1);
    Run run(compute, settings, *make_environment(settings));
    begin_run(run, make_data_set(settings));
    update(run);
    for (const int cores : {8, 32, 64}) {
        Forecast best;
        for (int round = 0; round < 2; ++round) {
            const Forecast one = rehearse(run, cores);
            if (one.alone + one.shared < best.alone + best.shared) best = one;
        }
        const double meetings = meeting * static_cast<double>(best.jobs), all = best.alone + best.shared + meetings;
        const double one_core = best.alone + best.in_tasks;
        const std::string group = "an eighth of an update of the gym network on more cores, forecast, " + label(kernel);
        measured.add({group, std::to_string(cores) + " cores", {all, all, all}});
        if (measured.json) continue;
        std::printf(
            "    %.1f times as fast as one core, of whose work %.2f%% is not shared out; time goes to that (%.0f%%), "
            "to waiting for a job's last task (%.0f%%) and to %zu meetings (%.0f%%)\n",
            one_core / all, 100 * best.alone / one_core, 100 * best.alone / all,
            100 * (best.shared - best.in_tasks / cores) / all, best.jobs, 100 * meetings / all);
    }
}

#endif

void bench_updates(Measurements& measured, const Kernel& kernel, int threads, const Rates& rates) {
    for (const char* preset : {"small", "paper"})
        bench_update(measured, kernel, threads, rates,
                     std::string(preset) == "small" ? "grid world, preset small" : "grid world, preset paper",
                     default_settings("gridworld", "wodtem", preset));
#ifdef WODTEM_MUJOCO
    bench_update(measured, kernel, threads, rates, "halfcheetah, preset paper", gym_settings());
#endif
}

// Points drawn uniformly from a cube; queries near stored points, as those of a replay buffer are. A look-up is counted
// with the bytes of one leaf: the nodes above it are shared by many. `bandwidth`: one core's, bytes a second.
void bench_memory(Measurements& measured, size_t entries, double bandwidth) {
    constexpr size_t queries = 5000, arrivals = 1000, rounds = 15;
    MemoryConfig config{};
    config.state_dim = config.projected_dim = 4;
    config.action_dim = 8;
    config.capacity = entries + (rounds + 1) * arrivals;
    config.K = 2;
    config.epsilon = 0.1;
    EpisodicMemory memory(config, 0);
    const Random random{1, Stream::data_set};
    std::vector<float> states, asked;
    for (size_t i = 0; i < config.capacity + rounds * arrivals; ++i)
        for (uint32_t j = 0; j < 4; ++j) states.push_back(static_cast<float>(10 * random.uniform(i, j)));
    const float* next = states.data();
    const auto take = [&](size_t n) {
        Trajectory trajectory;
        trajectory.states.assign(next, next + 4 * n);
        trajectory.actions.resize(8 * n);
        trajectory.rewards.resize(n);
        trajectory.discounted_returns.resize(n);
        next += 4 * n;
        return trajectory;
    };
    const Trajectory first = take(entries);
    std::vector<Trajectory> arriving;
    for (size_t i = 0; i < 2 * rounds + 1; ++i) arriving.push_back(take(arrivals));
    const Trajectory* arrived = arriving.data();
    const double insertion = seconds_of([&] { memory.update(first); });
    const Spread arrival = timed(rounds, [&] { memory.update(*arrived++); });
    const double build = seconds_of([&] { memory.rebuild_derived(); });
    memory.update(*arrived++);  // the first eviction orders all entries
    const Spread exchange = timed(rounds - 2, [&] { memory.update(*arrived++); });
    for (size_t i = 0, at = 0; i < 40 * queries; ++i) {
        at = (at + 7919) % entries;
        asked.insert(asked.end(), &states[4 * at], &states[4 * at + 4]);
        asked[4 * i] += 0.01f;
    }
    const float* ask = asked.data();
    const Spread look_up = timed(39, [&] {
        const Neighbourhoods found = memory.search(ask, queries);
        for (size_t i = 0; i < queries; ++i) memory.count_accesses(found[i]);
        ask += 4 * queries;
    });
    const std::string group =
        "memory, " + std::to_string(entries) + " entries in 4 dimensions, K = 2, one core; share of the memory's speed";
    const auto add = [&](const char* what, Spread spread, double n, double bytes = 0) {
        const Spread one = {spread.low / n, spread.median / n, spread.high / n};
        measured.add({group, what, one, 0, bytes, share_of(bytes / bandwidth, one)});
    };
    constexpr double leaf = sizeof(KdTree::LeafArray<float>) * (4 + 1);  // its points, and their numbers
    add("look-up, 5000 at once", look_up, queries, leaf);
    add("insertion, 1000 in a row", arrival, arrivals);
    add("insertion and eviction, 1000 in a row", exchange, arrivals);
    add("filling, an entry", {insertion, insertion, insertion}, static_cast<double>(entries));
    add("building tree and hash table, all", {build, build, build}, 1);
    if (!measured.json)
        std::printf("  %.0f bytes an entry\n",
                    static_cast<double>(memory_bytes(memory)) / static_cast<double>(memory.size()));
}

void bench_all(const std::string& kernel_name, int threads, bool json) {
    Measurements measured{json, {}};
    std::vector<const Kernel*> chosen;  // the best of each precision, or those of the name
    for (const Kernel* kernel : kernels) {
        const auto alike = [=](const Kernel* other) { return !std::strcmp(other->precision(), kernel->precision()); };
        const bool best = kernel != &kernel_portable_bf16 && std::ranges::none_of(chosen, alike);
        if (kernel->supported() && (kernel_name == "auto" ? best : kernel_name == kernel->name))
            chosen.push_back(kernel);
    }
    if (!json) std::printf("medians (and ranges); a share of the peak is of the peak of its own moment\n");
    for (const Kernel* kernel : chosen) {
        double peak = 0;
        for (int round = 0; round < 20; ++round) peak = std::max(peak, burn_rate(*kernel));
        const double second = 1e9 / peak;
        measured.add(
            {"peaks", "10^9 operations in registers, " + label(*kernel) + ", 1 core", {second, second, second}, 1e9});
    }
    const double bandwidth_of_one = bench_memory_bandwidth(measured, 1);
    const double bandwidth = bench_memory_bandwidth(measured, threads);
    std::vector<double> rates;
    for (const Kernel* kernel : chosen) rates.push_back(bench_products(measured, *kernel, threads));
    bench_other_kernels(measured, *chosen[0], threads, bandwidth);
    for (size_t i = 0; i < chosen.size(); ++i) bench_updates(measured, *chosen[i], threads, {rates[i], bandwidth});
#ifdef WODTEM_MUJOCO
    bench_many_cores(measured, *chosen[0]);
#endif
    rusage use{};
    getrusage(RUSAGE_SELF, &use);
    if (!json) std::printf("peak memory so far: %ld MB\n", use.ru_maxrss / 1024);
    for (const size_t entries : {size_t{200000}, size_t{2000000}}) bench_memory(measured, entries, bandwidth_of_one);
    if (json) measured.print_json();
}

#ifdef WODTEM_MUJOCO

// Episodes of random actions: through the environment, and as calls of the engine that the task cannot do without:
// mj_step frame_skip times per action (for maze2d mj_forward before it, which D4RL's velocity clip asks for).
void bench_environment(const MujocoTask& task) {
    MujocoEnvironment environment(task, Physics::d4rl);
    const mjModel* model = environment.model.get();
    mjData* data = environment.data.get();
    struct Recorded {
        std::vector<double> qpos, qvel, controls;
        Trajectory trajectory;
    };
    std::vector<Recorded> episodes;
    size_t steps = 0;
    for (uint64_t number = 0; steps < 1000; ++number) {
        std::vector<float> state(static_cast<size_t>(task.state_dim));
        environment.reset({0, Stream::environment}, data_set_episodes + number, state.data());
        Recorded episode{{data->qpos, data->qpos + model->nq}, {data->qvel, data->qvel + model->nv}, {}, {}};
        episode.trajectory = random_trajectory(environment, 0, number).value();
        steps += episode.trajectory.rewards.size();
        for (size_t i = 0; i < episode.trajectory.actions.size(); ++i) {  // what the actuators get, made beforehand
            const double* range = &model->actuator_ctrlrange[2 * (i % static_cast<size_t>(model->nu))];
            episode.controls.push_back(range[0] + (episode.trajectory.actions[i] + 1.0) * 0.5 * (range[1] - range[0]));
        }
        episodes.push_back(episode);
    }
    std::vector<float> state(static_cast<size_t>(task.state_dim));
    const auto ours = [&] {
        for (const Recorded& episode : episodes) {
            environment.start(episode.qpos, episode.qvel);
            for (size_t at = 0; at < episode.controls.size(); at += static_cast<size_t>(model->nu))
                environment.step(&episode.trajectory.actions[at], state.data());
        }
    };
    const auto bare = [&] {
        for (const Recorded& episode : episodes) {
            mj_resetData(model, data);
            std::copy(episode.qpos.begin(), episode.qpos.end(), data->qpos);
            std::copy(episode.qvel.begin(), episode.qvel.end(), data->qvel);
            mj_forward(model, data);
            for (size_t at = 0; at < episode.controls.size(); at += static_cast<size_t>(model->nu)) {
                if (task.rules == Rules::maze2d) mj_forward(model, data);
                std::copy_n(&episode.controls[at], model->nu, data->ctrl);
                for (int i = 0; i < task.frame_skip; ++i) mj_step(model, data);
            }
        }
    };
    ours();
    bare();
    std::vector<double> rates, overheads;  // of neighbours in time: a machine's speed moves
    for (int round = 0; round < 25; ++round) {
        const double a = seconds_of(ours), b = seconds_of(bare);
        rates.push_back(static_cast<double>(steps) / a);
        overheads.push_back(100 * (a / b - 1));
    }
    std::sort(rates.begin(), rates.end());
    std::sort(overheads.begin(), overheads.end());
    std::printf("  %-22s %9.0f steps/s, %8.0f mj_step/s, overhead %5.1f%%  (quartiles %.1f%% to %.1f%%)\n", task.name,
                rates[12], rates[12] * task.frame_skip, overheads[12], overheads[6], overheads[18]);
}

// The learner of the medium-replay sets, on hopper: a step of the environment and an update after each.
void bench_learner(const Kernel& kernel, int threads) {
    LiveTask environment(*find_mujoco_task("hopper"));
    sac::Settings settings = gym_training(*environment.body.task, 0, 20000).settings;
    settings.random_steps = 1000, settings.steps_per_update = 1;
    Compute compute(kernel, threads);
    sac::Learner learner(settings, environment.spec(), compute);
    const auto learn = [&] {
        for (const uint64_t end = learner.progress.updates + 200; learner.progress.updates < end;)
            learner.step(environment);
    };
    const Spread seconds = timed(9, learn);
    std::printf("hopper's soft actor-critic, batch %d, %d threads: %.0f steps/s with an update each (%.0f to %.0f)\n",
                settings.batch, threads, 200 / seconds.median, 200 / seconds.high, 200 / seconds.low);
}

struct RandomPolicy {
    std::vector<double> lengths, returns;  // of each episode
};

// Uniformly random actions, spread over threads; the same episodes for any number of them.
RandomPolicy play_randomly(const MujocoTask& task, Physics physics, int count, int threads) {
    Threads workers(threads);
    std::vector<MujocoEnvironment> environments(static_cast<size_t>(threads), MujocoEnvironment(task, physics));
    const std::vector<double> none(static_cast<size_t>(count));
    RandomPolicy result{none, none};
    workers.run(count, [&](int episode, int worker) {
        const size_t i = static_cast<size_t>(episode);
        const auto trajectory = random_trajectory(environments[static_cast<size_t>(worker)], 0, i);
        result.lengths[i] = trajectory ? static_cast<double>(trajectory->length()) : NAN;
        result.returns[i] =
            trajectory ? std::accumulate(trajectory->rewards.begin(), trajectory->rewards.end(), 0.0) : NAN;
    });
    return result;
}

// What is published of D4RL's -random-v2 sets, a million steps each: mean length (steps / episodes), mean return. For
// mazes the reference score's minimum: the mean of 100 random episodes.
struct PublishedRandom {
    const char* task;
    int episodes;  // that we play: their standard error resolves the two physics where the tasks do
    double length, total;
};
constexpr PublishedRandom published_random[] = {
    {"hopper", 120000, 1e6 / 45240, 18.399}, {"walker2d", 12000, 1e6 / 48908, 1.871},
    {"halfcheetah", 400, 1000, -288.8},      {"ant", 1200, 1e6 / 5822, NAN},
    {"maze2d-umaze", 1000, 300, 23.85},      {"maze2d-medium", 1000, 600, 13.13},
    {"maze2d-large", 1000, 800, 6.7},        {"antmaze-umaze", 40, 700, 0},
};

void bench_random_policy(int threads) {
    for (const PublishedRandom& row : published_random)
        for (const Physics physics : {Physics::d4rl, Physics::mujoco_2_2}) {
            const MujocoTask& task = *find_mujoco_task(row.task);
            if (task.rules == Rules::maze2d && physics == Physics::mujoco_2_2) continue;  // a ball is a ball
            const RandomPolicy result = play_randomly(task, physics, row.episodes, threads);
            const Moments length = moments_of(result.lengths), total = moments_of(result.returns);
            const double root = std::sqrt(length.count);  // of a standard error
            std::printf("  %-14s %-4s %6d episodes  length %8.3f +- %.3f (published %.3f)  return %8.3f +- %.3f (%s)\n",
                        task.name, physics_names[static_cast<size_t>(physics)], row.episodes, length.mean(),
                        length.sample_deviation() / root, row.length, total.mean(), total.sample_deviation() / root,
                        std::isnan(row.total) ? "not published" : ("published " + number_text(row.total)).c_str());
        }
}

#endif

// Seconds that a run takes here: the mean time of three updates, after one that allocates, times all updates expected.
double estimated_seconds(Settings settings, const Kernel& kernel) {
    if (settings.task != "gridworld") settings.behaviour = "random";
    Compute compute(kernel, default_threads(settings));
    Run run(compute, settings, *make_environment(settings));
    begin_run(run, make_data_set(settings));
    update(run);
    const Clock::time_point begin = Clock::now();
    for (int i = 0; i < 3; ++i) update(run);
    return seconds_since(begin) / 3 * expected_updates(settings);
}

void command_bench(const Arguments& arguments) {
    kernel_of(arguments);  // refuses what the machine lacks
    const int threads = thread_count(arguments);
    const std::string what = arguments.words.empty() ? "updates" : arguments.words[0];
    if (what != "updates" && what != "environments" && what != "random-policy")
        fail("usage.words", "bench cannot measure \"%s\"; it is updates, environments or random-policy", what.c_str());
    if (what == "updates") return bench_all(arguments["--kernel"], threads, arguments.has("--json"));
#ifdef WODTEM_MUJOCO
    std::printf("MuJoCo %s, uniformly random actions\n", mujoco_version().c_str());
    if (what == "random-policy") return bench_random_policy(threads);
    std::printf("one core, physics d4rl; medians of 25 rounds; overhead: beside the engine's calls alone\n");
    for (const MujocoTask& task : mujoco_tasks) bench_environment(task);
    bench_learner(kernel_of(arguments), threads);
#else
    fail("mujoco.absent", "MuJoCo 2.2 was not there when this program was built; %s", mujoco_advice);
#endif
}
