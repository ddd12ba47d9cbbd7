// bench.hpp: what `wodtem bench` measures, all in one run, so that ratios mean something: the machine's fp32 peak with
// registers alone, each kernel's share of it at the shapes that training uses, one update, one memory look-up.
// Medians and ranges; a machine's clock moves with its neighbours, so figures of different runs do not compare.
// Included by wodtem.cpp, after training. Leaves out: judging; a test never looks at a clock.
#pragma once

#include <sys/resource.h>

double seconds_of(const std::function<void()>& work) {
    const auto begin = Console::Clock::now();
    work();
    return Console::seconds_between(begin, Console::Clock::now());
}

struct Spread {
    double low, median, high;
};

// Of `rounds` runs, after one that does not count.
Spread timed(int rounds, const std::function<void()>& work) {
    work();
    std::vector<double> seconds;
    for (int round = 0; round < rounds; ++round) seconds.push_back(seconds_of(work));
    std::sort(seconds.begin(), seconds.end());
    return {seconds.front(), seconds[seconds.size() / 2], seconds.back()};
}

// The shapes of the paper's grid-world network at batch 256, and of a gym network's layer on 1024 tokens.
void bench_products(const Kernel& kernel) {
    Compute compute(kernel, 1);
    volatile float sink = 0;
    const double burn_count = 3e8;  // operations: a few milliseconds
    const auto burn_rate = [&] {
        return burn_count /
               seconds_of([&] { sink = sink + kernel.burn(static_cast<int64_t>(burn_count / burn_flops(kernel))); }) /
               1e9;
    };
    burn_rate();
    double peak = 0;
    for (int round = 0; round < 20; ++round) peak = std::max(peak, burn_rate());
    std::printf("%s: fp32 peak of one core %.1f GFLOP/s (registers only)\n", kernel.name, peak);
    struct Case {
        const char* what;
        int M, N, K;
        bool a_transposed, b_transposed;
    };
    for (const Case& s :
         {Case{"keys, values", 512, 1024, 512, false, false}, Case{"attention out", 256, 512, 512, false, false},
          Case{"MLP in", 256, 2048, 512, false, false}, Case{"MLP out", 256, 512, 2048, false, false},
          Case{"MLP in, d input", 256, 512, 2048, false, true}, Case{"MLP in, d weight", 512, 2048, 256, true, false},
          Case{"gym MLP in", 1024, 2048, 512, false, false}, Case{"small MLP in", 256, 64, 16, false, false}}) {
        const auto size = [](int rows, int columns) {
            return static_cast<size_t>(rows) * static_cast<size_t>(columns);
        };
        const std::vector<float> a(size(s.M, s.K), 0.5f), b(size(s.K, s.N), 0.25f);
        std::vector<float> c(size(s.M, s.N));
        const double flops = 2.0 * s.M * s.N * s.K;
        const int repeats = std::max(1, static_cast<int>(5e8 / flops));
        const auto multiply = [&] {
            for (int i = 0; i < repeats; ++i)
                matmul(compute, View<float>{c.data(), s.N}, {a.data(), s.a_transposed ? s.M : s.K, s.a_transposed},
                       {b.data(), s.b_transposed ? s.K : s.N, s.b_transposed}, s.M, s.N, s.K, Store::overwrite);
        };
        multiply();
        std::vector<double> rates, shares;  // each beside the peak of its own moment: neighbours come and go
        for (int round = 0; round < 15; ++round) {
            const double before = burn_rate(), rate = flops * repeats / seconds_of(multiply) / 1e9;
            rates.push_back(rate);
            shares.push_back(100 * rate / std::max(before, burn_rate()));
        }
        std::sort(rates.begin(), rates.end());
        std::sort(shares.begin(), shares.end());
        std::printf("  %-18s %5d x %4d x %4d  %7.1f GFLOP/s  %3.0f%% of peak  (%.0f%% to %.0f%%)\n", s.what, s.M, s.N,
                    s.K, rates[7], shares[7], shares.front(), shares.back());
    }
}

// Arithmetic of one update that the action prediction needs (2 a multiply-add; forward, and twice that backward), with
// whole windows of C steps: 3C - 1 tokens in every layer but the last, which needs keys and values of all tokens and the
// rest for the C state tokens; attention sees half of the tokens on average.
double update_flops(const Settings& settings) {
    const double d = static_cast<double>(settings.width), C = static_cast<double>(settings.context_length);
    const double tokens = 3 * C - 1, whole_layer = tokens * (12 * d * d + tokens * d),
                 last_layer = tokens * 2 * d * d + C * (10 * d * d + tokens * d);
    return 6 * static_cast<double>(settings.batch_size) *
           (static_cast<double>(settings.layers - 1) * whole_layer + last_layer);
}

template <class Environment>
void bench_update(const Kernel& kernel, int threads, const char* what, const Settings& settings,
                  const Environment& environment) {
    Compute compute(kernel, threads);
    Run run(compute, settings, environment.spec());
    begin_run(run, make_data_set(settings, environment));
    const int repeats = std::max(1, static_cast<int>(1e9 / update_flops(settings)));
    const Spread time = timed(update_flops(settings) > 1e11 ? 3 : 7, [&] {
        for (int i = 0; i < repeats; ++i) update(run);
    });
    std::printf("  WODTEM update, %-28s %d thread%s %9.3f ms (%.3f to %.3f)  %6.1f GFLOP/s of %.4g GFLOP\n", what,
                threads, threads == 1 ? " " : "s", time.median / repeats * 1e3, time.low / repeats * 1e3,
                time.high / repeats * 1e3, update_flops(settings) * repeats / time.median / 1e9,
                update_flops(settings) / 1e9);
}

void bench_updates(const Kernel& kernel, int threads) {
    for (int count = 1; count <= threads; count *= 2) {
        for (const char* preset : {"small", "paper"}) {
            const Settings settings = default_settings("gridworld", "wodtem", preset);
            bench_update(kernel, count,
                         std::string(preset) == "small" ? "grid world, preset small" : "grid world, preset paper",
                         settings, GridWorld{});
        }
#ifdef WODTEM_MUJOCO  // whose episodes fill whole windows
        Settings gym = default_settings("halfcheetah-v2", "wodtem", "paper");
        set_setting(gym, "behaviour", "random");
        bench_update(kernel, count, "halfcheetah, preset paper", gym,
                     MujocoEnvironment(*find_mujoco_task("halfcheetah"), Physics::d4rl));
#endif
    }
    rusage use{};
    getrusage(RUSAGE_SELF, &use);
    std::printf("  peak memory so far: %ld MB\n", use.ru_maxrss / 1024);
}

// Points drawn uniformly from a cube; queries near stored points, as those of a replay buffer are.
void bench_memory(size_t entries) {
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
    const std::array<float, 8> action{};
    EpisodicMemory::Changes changes;
    const float* next = states.data();
    const auto insert = [&](size_t n) {
        for (size_t i = 0; i < n; ++i, next += 4) memory.update_one(changes, next, action.data(), 1.0);
    };
    const double insertion = seconds_of([&] { insert(entries); });
    const Spread arrival = timed(rounds, [&] { insert(arrivals); });
    const double build =
        seconds_of([&] { memory.tree.build(memory.points(), 4, static_cast<uint32_t>(memory.size())); });
    insert(1);  // the first eviction orders all entries
    const Spread exchange = timed(rounds - 2, [&] { insert(arrivals); });
    for (size_t i = 0, at = 0; i < 40 * queries; ++i) {
        at = (at + 7919) % entries;
        asked.insert(asked.end(), &states[4 * at], &states[4 * at + 4]);
        asked[4 * i] += 0.01f;
    }
    const float* ask = asked.data();
    const Spread time = timed(39, [&] {
        const Neighbourhoods found = memory.search(ask, queries);
        for (size_t i = 0; i < queries; ++i) memory.count_accesses(found[i]);
        ask += 4 * queries;
    });
    const auto print = [](const char* what, const Spread& spread, double n) {
        std::printf("    %-42s %.3f us (%.3f to %.3f)\n", what, spread.median / n * 1e6, spread.low / n * 1e6,
                    spread.high / n * 1e6);
    };
    std::printf(
        "  memory, %zu entries in 4 dimensions, K = 2, one core: filled in %.2f s, tree built in %.2f s, %.0f bytes an entry\n",
        entries, insertion, build, static_cast<double>(memory.bytes()) / static_cast<double>(memory.size()));
    print("look-up, 5000 at once", time, queries);
    print("insertion, 1000 in a row", arrival, arrivals);
    print("insertion and eviction, 1000 in a row", exchange, arrivals);
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

// Mean and standard error over episodes.
std::pair<double, double> mean_and_error(const std::vector<double>& values) {
    double sum = 0, squares = 0;
    for (const double x : values) sum += x;
    const double n = static_cast<double>(values.size()), mean = sum / n;
    for (const double x : values) squares += (x - mean) * (x - mean);
    return {mean, std::sqrt(squares / (n - 1) / n)};
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
            const auto [length, length_error] = mean_and_error(result.lengths);
            const auto [total, total_error] = mean_and_error(result.returns);
            std::printf("  %-14s %-4s %6d episodes  length %8.3f +- %.3f (published %.3f)  return %8.3f +- %.3f (%s)\n",
                        task.name, physics_names[static_cast<size_t>(physics)], row.episodes, length, length_error,
                        row.length, total, total_error,
                        std::isnan(row.total) ? "not published" : ("published " + number_text(row.total)).c_str());
        }
}

#endif
