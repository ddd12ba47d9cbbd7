// test_memory.cpp: memory.hpp against closed forms, O(T^2) definitions, linear scans and a table told a second way.
#include <cstring>
#include <map>
#include <numeric>
#include <set>

#include "../data/state.hpp"
#include "../memory.hpp"
#include "memory_bytes.hpp"
#include "plain.hpp"
#include "test.hpp"

namespace {

constexpr double gamma_dr = 0.99;

// A one-action-dimension trajectory that earns `d` at its only step.
Trajectory one_step(std::vector<float> state, float action, float d) {
    Trajectory trajectory;
    trajectory.states = std::move(state);
    trajectory.actions = {action};
    trajectory.rewards = {d};
    relabel(trajectory, static_cast<int>(trajectory.states.size()), 1, gamma_dr);
    return trajectory;
}

// A trajectory of T steps in one state dimension with the given total return.
Trajectory with_return(int T, float total, float mark = 0.0f) {
    Trajectory trajectory;
    trajectory.states.assign(static_cast<size_t>(T), mark);
    trajectory.actions.assign(static_cast<size_t>(T), mark);
    trajectory.rewards.assign(static_cast<size_t>(T), 0.0f);
    trajectory.rewards[0] = total;
    relabel(trajectory, 1, 1, gamma_dr);
    return trajectory;
}

// One state dimension, no projection, K = 2, epsilon = 0.5, capacity 100.
MemoryConfig small() {
    return {.state_dim = 1, .action_dim = 1, .projected_dim = 0, .capacity = 100, .K = 2, .epsilon = 0.5};
}

// A table with these (state, action, e).
EpisodicMemory table_of(const MemoryConfig& config, const std::vector<std::array<float, 3>>& entries) {
    EpisodicMemory memory(config, 1);
    for (const auto& [state, action, e] : entries) memory.update(one_step({state}, action, e));
    return memory;
}

std::vector<Neighbour> search(const EpisodicMemory& memory, const float* state) {
    const Neighbourhoods found = memory.search(state, 1);
    return {found[0].begin(), found[0].end()};
}

std::vector<Neighbour> search_and_count(EpisodicMemory& memory, const float* state) {
    const std::vector<Neighbour> found = search(memory, state);
    memory.count_accesses(found);
    return found;
}

std::vector<uint32_t> entries_of(const std::vector<Neighbour>& found) {
    std::vector<uint32_t> entries;
    for (const Neighbour& neighbour : found) entries.push_back(neighbour.entry);
    return entries;
}

bool same(std::span<const Neighbour> a, std::span<const Neighbour> b) {
    const auto equal = [](const Neighbour& x, const Neighbour& y) {
        return x.entry == y.entry && std::bit_cast<uint32_t>(x.distance) == std::bit_cast<uint32_t>(y.distance);
    };
    return std::equal(a.begin(), a.end(), b.begin(), b.end(), equal);
}

// Keeps the bytes of every field by name: a checkpoint without a file.
struct ToyArchive {
    bool loading = false;
    std::map<std::string, std::vector<unsigned char>> fields = {};

    template <class Number>
    void operator()(const char* name, std::vector<Number>& values) {
        if (loading) values.resize(fields.at(name).size() / sizeof(Number));
        if (!loading) fields[name].resize(values.size() * sizeof(Number));
        if (values.empty()) return;
        if (loading) std::memcpy(values.data(), fields[name].data(), fields[name].size());
        if (!loading) std::memcpy(fields[name].data(), values.data(), fields[name].size());
    }
    void operator()(const char* name, uint64_t& value) {
        std::vector<uint64_t> one = {value};
        (*this)(name, one);
        value = one.at(0);
    }
};

// The table told a second way: a map from states to entries, eviction and neighbours by looking at all of them.
struct NaiveMemory {
    struct Entry {
        float action;
        double e;
        uint64_t count, last, age;
    };
    using Found = std::vector<std::pair<std::pair<float, uint64_t>, std::vector<float>>>;  // ((distance, age), state)
    MemoryConfig config;
    std::map<std::vector<float>, Entry> table = {};
    uint64_t clock = 0, born = 0;

    void access(Entry& entry) {
        ++entry.count;
        entry.last = ++clock;
    }
    void update(const std::vector<float>& state, float action, double d) {
        const auto known = table.find(state);
        if (known != table.end()) {
            access(known->second);
            if (known->second.e < d) known->second.e = d, known->second.action = action;
            return;
        }
        if (table.size() == config.capacity) {
            const auto rank = [&](const Entry& entry) {
                return std::pair(config.eviction == Eviction::lfu ? entry.count : entry.last, entry.age);
            };
            auto victim = table.begin();
            for (auto i = table.begin(); i != table.end(); ++i)
                if (rank(i->second) < rank(victim->second)) victim = i;
            table.erase(victim);
        }
        access(table[state] = {action, d, 0, 0, born++});
    }
    Found neighbours(const std::vector<float>& state) {
        Found all;
        for (const auto& [other, entry] : table) {
            float distance = 0.0f;
            for (size_t d = 0; d < state.size(); ++d) distance += (other[d] - state[d]) * (other[d] - state[d]);
            if (!(config.exclude_self && other == state)) all.push_back({{distance, entry.age}, other});
        }
        std::sort(all.begin(), all.end());
        all.resize(std::min(all.size(), static_cast<size_t>(config.K)));
        while (!all.empty() && all.back().first.first >= config.epsilon) all.pop_back();
        for (const auto& neighbour : all) access(table[neighbour.second]);
        return all;
    }
};

// Random updates and look-ups over a small lattice, so that exact hits, ties and evictions are all frequent.
void compare_with_naive(const MemoryConfig& config, int operations, uint32_t salt) {
    EpisodicMemory memory(config, 1);
    NaiveMemory naive{config};
    const Random random{test_seed() + salt, Stream::data_set};
    uint64_t evicted = 0, found_any = 0;
    for (uint64_t i = 0; i < static_cast<uint64_t>(operations) && failed_checks() == 0; ++i) {
        const auto draw = [&](uint64_t bound, uint32_t index) {
            return static_cast<float>(random.below(bound, i, index));
        };
        const std::vector<float> state = {draw(12, 0) * 0.5f, draw(12, 1) * 0.5f};
        if (random.below(3, i, 2) == 0) {
            const auto d = draw(20, 3);
            evicted += memory.update(one_step(state, draw(8, 4), d)).evicted;
            naive.update(state, draw(8, 4), d);
        } else {
            const auto found = search_and_count(memory, state.data());
            const auto expected = naive.neighbours(state);
            CHECK_EQUAL(found.size(), expected.size());
            for (size_t k = 0; k < std::min(found.size(), expected.size()); ++k) {
                CHECK_EQUAL(found[k].distance, expected[k].first.first);
                CHECK_EQUAL(memory.age[found[k].entry], expected[k].first.second);
                CHECK_EQUAL(memory.e[found[k].entry], naive.table[expected[k].second].e);
            }
            found_any += !found.empty();
        }
        if (random.below(1000, i, 5) == 0) memory.rebuild_derived();  // as after a load
    }
    CHECK(evicted > 100 && found_any > 100);
    CHECK_EQUAL(memory.size(), naive.table.size());
    for (uint32_t i = 0; i < memory.size(); ++i) {
        const auto entry = naive.table.find({memory.projected[2 * i], memory.projected[2 * i + 1]});
        if (entry == naive.table.end()) return report_failure(__FILE__, __LINE__, "an entry that should be gone");
        CHECK_EQUAL(memory.actions[i], entry->second.action);
        CHECK_EQUAL(memory.e[i], entry->second.e);
        CHECK_EQUAL(memory.age[i], entry->second.age);
        CHECK_EQUAL(memory.priority[i], config.eviction == Eviction::lfu ? entry->second.count : entry->second.last);
    }
}

// The entries in the tree are `inside`, each in one lane, with its coordinates and on its side of every plane above;
// every node and every place is used once or free, counts are right, the tree is balanced and no path is too long.
void check_tree(const EpisodicMemory& memory, std::vector<uint32_t> inside) {
    using Rank = std::pair<float, uint32_t>;  // (coordinate, entry), the order in which planes divide
    struct Box {
        std::vector<Rank> low, high;  // [dim] the first rank inside, the first beyond
    };
    const KdTree& tree = memory.tree;
    std::vector<uint32_t> met;
    std::set<uint32_t> nodes, places;
    size_t deepest = 0;
    const auto below = [&](const auto& self, uint32_t node, const Box& box, size_t depth) -> size_t {
        const auto [child, dim, split, count] = tree.nodes.at(node);
        CHECK(nodes.insert(node).second);
        deepest = std::max(deepest, depth);
        if (dim != KdTree::leaf) {
            Box low = box, high = box;
            const Rank plane = {split, tree.split_entry.at(node)};
            low.high[dim] = std::min(box.high[dim], plane);
            high.low[dim] = std::max(box.low[dim], plane);
            const size_t in_low = self(self, child, low, depth + 1), in_high = self(self, child + 1, high, depth + 1);
            CHECK_EQUAL(size_t{count}, in_low + in_high);
            CHECK(count > KdTree::lanes / 2 && 3 * std::max(in_low, in_high) <= 2 * size_t{count} + 2);
            return count;
        }
        CHECK(count <= KdTree::lanes);
        CHECK(places.insert(child).second);
        for (uint32_t lane = 0; lane < count; ++lane) {
            const uint32_t entry = tree.entries.at(child)[lane];
            met.push_back(entry);
            for (size_t d = 0; d < memory.dim; ++d) {
                const Rank x = {tree.coordinates[child * memory.dim + d][lane], entry};
                CHECK_EQUAL(x.first, memory.projected[entry * memory.dim + d]);
                CHECK(box.low[d] <= x && x < box.high[d]);
            }
        }
        return count;
    };
    below(below, 0, {std::vector<Rank>(memory.dim, {-INFINITY, 0}), std::vector<Rank>(memory.dim, {INFINITY, 0})}, 0);
    std::sort(met.begin(), met.end());
    std::sort(inside.begin(), inside.end());
    CHECK(met == inside);
    CHECK_EQUAL(tree.nodes.size(), 2 * tree.entries.size());
    CHECK_EQUAL(tree.split_entry.size(), tree.nodes.size());
    CHECK_EQUAL(places.size(), tree.entries.size() - tree.free_pairs.size());
    CHECK_EQUAL(nodes.size(), 2 * places.size() - 1);
    // An inner node holds more than 8, and its lighter child about a third: no leaves of fewer than 4 on average.
    CHECK(4 * places.size() <= inside.size() + KdTree::lanes);
    for (const uint32_t pair : tree.free_pairs) CHECK(nodes.insert(2 * pair).second && places.insert(pair).second);
    const double largest = static_cast<double>(std::max<size_t>(inside.size(), 1));
    CHECK(static_cast<double>(deepest) <= std::max(0.0, std::log(largest / 4) / std::log(1.5)));
    CHECK(deepest <= KdTree::longest_path);
}

void check_tree(const EpisodicMemory& memory) {
    std::vector<uint32_t> inside(memory.size());
    std::iota(inside.begin(), inside.end(), 0u);
    check_tree(memory, inside);
}

enum class Shape { uniform, lattice, clusters, walk, line, point };

// State i of a sequence that fills space evenly, on a lattice with many ties (some states in it twice), in few small
// heaps, along a path, along an axis from left to right, or not at all.
std::vector<float> state_of(Shape shape, const Random& random, int dim, uint64_t i) {
    const auto coordinate = [&](uint32_t d) {
        const auto x = static_cast<float>(random.uniform(i, d));
        if (shape == Shape::uniform) return 4 * x;
        if (shape == Shape::lattice) return std::floor(x * (d < 2 ? 32 : 4)) / 8;
        if (shape == Shape::clusters) return 4 * static_cast<float>(random.uniform(i % 7, d)) + x * 1e-3f;
        if (shape == Shape::walk) return 2 + 2 * std::sin(0.01f * static_cast<float>(i * (d + 1))) + x * 0.02f;
        return shape == Shape::line && d == 0 ? static_cast<float>(i) * 0.01f : 1.0f;
    };
    std::vector<float> state;
    for (uint32_t d = 0; d < static_cast<uint32_t>(dim); ++d) state.push_back(coordinate(d));
    return state;
}

// q(s_q, s_k) = ||s_q - s_k||^2, summed in float in the order of the dimensions.
float squared_distance(const float* a, const float* b, size_t dim) {
    float sum = 0.0f;
    for (size_t d = 0; d < dim; ++d) sum += (a[d] - b[d]) * (a[d] - b[d]);
    return sum;
}

// K(s_q) of a projected s_q [dim] by a scan of all entries; `skipped` is passed over.
std::vector<Neighbour> nearest_plain(const EpisodicMemory& memory, const float* point, uint32_t skipped) {
    std::vector<Neighbour> found;
    for (uint32_t i = 0; i < memory.size(); ++i) {
        const float distance = squared_distance(&memory.projected[i * memory.dim], point, memory.dim);
        if (i != skipped && distance < memory.config.epsilon) found.push_back({distance, i});
    }
    std::sort(found.begin(), found.end(), [&](auto& a, auto& b) { return memory.points().closer(a, b); });
    found.resize(std::min(found.size(), static_cast<size_t>(memory.config.K)));
    return found;
}

// The tree against the scan, for many points at once and for one alone: around the table's states and at them.
void compare_with_plain(const EpisodicMemory& memory, uint64_t salt, uint32_t n = 40) {
    const Random random{test_seed(), Stream::exploration};
    std::vector<float> points;
    std::vector<uint32_t> skipped;
    for (uint32_t i = 0; i < n; ++i) {
        const size_t near = memory.size() > 0 ? random.below(memory.size(), salt, i) : 0;
        for (uint32_t d = 0; d < memory.dim; ++d) {
            const float noise = random.normal(salt, i, d), scales[] = {0, 0.01f, 0.125f, 3};
            points.push_back((memory.size() > 0 ? memory.projected[near * memory.dim + d] : 0) + scales[i % 4] * noise);
            if (i % 4 == 2) points.back() = std::round(points.back() * 16) / 16;  // ties on a lattice
        }
        skipped.push_back(memory.size() > 0 && i % 3 == 0 ? static_cast<uint32_t>(near) : no_entry);
    }
    const Neighbourhoods found = memory.nearest(points, skipped, memory.reach());
    for (uint32_t i = 0; i < n; ++i) {
        const float* at = &points[i * memory.dim];
        CHECK(same(found[i], nearest_plain(memory, at, skipped[i])));
        if (i % 8 == 0) CHECK(same(found[i], memory.nearest({at, at + memory.dim}, {skipped[i]}, memory.reach())[0]));
    }
}

}  // namespace

// ---- Returns and replay

// WODTEM sec. III-A, g_t test; WODTEM sec. III-A, d_t test
TEST(returns_are_the_sums_of_their_definition) {
    const Random random{test_seed(), Stream::data_set};
    std::vector<float> rewards;
    for (uint32_t t = 0; t < 100; ++t) rewards.push_back(random.normal(0, t));
    for (const double gamma : {0.99, 1.0}) {
        const std::vector<double> d = discounted_returns(rewards, gamma);
        for (size_t t = 0; t < rewards.size(); ++t) {
            double sum = 0.0, factor = 1.0;
            for (size_t u = t; u < rewards.size(); ++u, factor *= gamma) sum += factor * rewards[u];
            CHECK_CLOSE(d[t], sum, 1e-12);
        }
    }
    CHECK(returns_to_go(rewards) == discounted_returns(rewards, 1.0));
    CHECK(returns_to_go({3.0f, -1.0f, 2.0f}) == (std::vector<double>{4.0, 1.0, 2.0}));
    CHECK(discounted_returns({1.0f, 2.0f, 4.0f}, 0.5) == (std::vector<double>{3.0, 4.0, 4.0}));
    CHECK(discounted_returns({7.0f}, gamma_dr) == std::vector<double>{7.0});  // length 1
}

TEST(relabel_refuses_wrong_sizes_and_numbers_that_are_not_finite) {
    Trajectory good = with_return(3, 1.0f), bad = good;
    bad.states.pop_back();
    CHECK_FAILS("memory.shape", relabel(bad, 1, 1, gamma_dr));
    CHECK_FAILS("memory.shape", bad = Trajectory{}; relabel(bad, 1, 1, gamma_dr));
    CHECK_FAILS("memory.shape", bad = good; bad.states.resize(6); relabel(bad, 1, 1, gamma_dr));
    CHECK_FAILS("memory.shape", bad = good; bad.actions.resize(6); relabel(bad, 1, 1, gamma_dr));
    for (const float evil : {NAN, INFINITY, -INFINITY}) {
        CHECK_FAILS("memory.not_finite", bad = good; bad.states[2] = evil; relabel(bad, 1, 1, gamma_dr));
        CHECK_FAILS("memory.not_finite", bad = good; bad.actions[1] = evil; relabel(bad, 1, 1, gamma_dr));
        CHECK_FAILS("memory.not_finite", bad = good; bad.rewards[0] = evil; relabel(bad, 1, 1, gamma_dr));
    }
}

TEST(offline_set_drops_exactly_one_lowest_return) {
    const std::vector<Trajectory> all = {with_return(1, 5), with_return(1, 2, 1), with_return(1, 2, 2),
                                         with_return(1, 9)};
    const auto kept = offline_set(all, false);
    CHECK_EQUAL(kept.size(), size_t{3});
    CHECK_EQUAL(total_return(kept[0]), 5.0);
    CHECK_EQUAL(kept[1].states[0], 2.0f);  // of the two lowest the first went
    CHECK_EQUAL(offline_set(all, true).size(), size_t{4});
    CHECK_EQUAL(offline_set({all[0]}, false).size(), size_t{1});  // never the only one
    CHECK_EQUAL(offline_set({}, false).size(), size_t{0});
    CHECK_FAILS("memory.not_relabelled", offline_set({Trajectory{}, Trajectory{}}, false));
}

// WODTEM sec. III-A, D_online test
TEST(replay_starts_from_low_to_high_return_and_overwrites_from_the_lowest) {
    ReplayBuffer replay{.state_dim = 1, .action_dim = 1, .gamma = gamma_dr, .capacity = 3};
    const auto marks = [&] {
        std::string text;
        for (const Trajectory& trajectory : replay.trajectories)
            text += static_cast<char>('a' + static_cast<int>(trajectory.states[0]));
        return text;
    };
    replay.start(
        {with_return(1, 4, 0), with_return(1, 1, 1), with_return(1, 4, 2), with_return(1, 8, 3), with_return(1, 2, 4)});
    CHECK_EQUAL(marks(), "acd");  // 4, 4, 8: equal returns in the order of the data set
    std::string seen;
    for (int i = 5; i < 9; ++i) replay.add(with_return(1, 0, static_cast<float>(i))), seen += marks() + " ";
    CHECK_EQUAL(seen, "fcd fgd fgh igh ");  // a lap and one
    replay.start({with_return(1, 7, 0), with_return(1, 3, 1)});
    CHECK_EQUAL(marks(), "ba");
    replay.add(with_return(1, 0, 2));  // full by one
    CHECK_EQUAL(marks(), "bac");
    replay.add(with_return(1, 0, 3));
    CHECK_EQUAL(marks(), "dac");
}

// WODTEM sec. III-B, C^t test
TEST(replay_samples_every_step_alike_and_cuts_windows_at_the_end) {
    ReplayBuffer replay{.state_dim = 1, .action_dim = 1, .gamma = gamma_dr, .capacity = 4};
    const Random random{test_seed(), Stream::batch};
    CHECK_FAILS("replay.empty", replay.sample(random, 0, 0, 5, Sampling::by_length));
    replay.start({with_return(7, 1)});
    for (uint32_t i = 0; i < 50; ++i)
        CHECK_EQUAL(replay.sample(random, 0, i, 5, Sampling::by_length).trajectory, size_t{0});
    replay.start({with_return(1, 1), with_return(10, 2), with_return(3, 3), with_return(40, 4)});
    replay.add(with_return(6, 0));  // overwrites the one of length 1: 59 steps
    std::map<std::pair<size_t, int>, int> hits;
    const int draws = 59000;
    for (uint32_t i = 0; i < draws; ++i) {
        const Window window = replay.sample(random, i / 256, i % 256, 5, Sampling::by_length);
        const int T = replay.trajectories.at(window.trajectory).length();
        CHECK(window.start >= 0 && window.start < T);
        CHECK_EQUAL(window.length, std::min(5, T - window.start));
        ++hits[{window.trajectory, window.start}];
    }
    double chi_square = 0.0;
    for (const auto& [window, count] : hits) chi_square += (count - 1000.0) * (count - 1000.0) / 1000.0;
    CHECK_EQUAL(hits.size(), size_t{59});
    CHECK(chi_square < 58 + 5 * 10.8);  // mean 58, standard deviation sqrt(2 * 58) = 10.8
}

// WODTEM sec. III-B, C^t test
TEST(replay_draws_trajectories_alike_where_sampling_is_uniform) {
    ReplayBuffer replay{.state_dim = 1, .action_dim = 1, .gamma = gamma_dr, .capacity = 4};
    const Random random{test_seed(), Stream::batch};
    replay.start({with_return(1, 1), with_return(10, 2), with_return(3, 3), with_return(40, 4)});
    std::map<std::pair<size_t, int>, int> hits;
    const int draws = 40000;
    for (uint32_t i = 0; i < draws; ++i) {
        const Window window = replay.sample(random, i / 256, i % 256, 5, Sampling::uniform);
        const int T = replay.trajectories.at(window.trajectory).length();
        CHECK_EQUAL(window.length, std::min(5, T - window.start));
        ++hits[{window.trajectory, window.start}];
    }
    double chi_square = 0;
    for (const auto& [window, count] : hits) {  // a step of a trajectory of T steps has probability 1 / (4 T)
        const double expected = draws / 4.0 / replay.trajectories.at(window.first).length();
        chi_square += (count - expected) * (count - expected) / expected;
    }
    CHECK_EQUAL(hits.size(), size_t{54});
    CHECK(chi_square < 53 + 5 * 10.3);  // mean 53, standard deviation sqrt(2 * 53) = 10.3
}

// ---- The table

// WODTEM eq. (4) test
TEST(update_inserts_unknown_states_and_keeps_the_higher_return) {
    EpisodicMemory memory(small(), 1);
    CHECK_EQUAL(memory.update(one_step({1}, 10, 5)).inserted, 1u);
    CHECK_EQUAL(memory.update(one_step({1}, 11, 4)).kept, 1u);
    CHECK_EQUAL(memory.actions[0], 10.0f);
    CHECK_EQUAL(memory.update(one_step({1}, 12, 5)).kept, 1u);  // equal: the older action stays
    CHECK_EQUAL(memory.actions[0], 10.0f);
    CHECK_EQUAL(memory.update(one_step({1}, 13, 6)).improved, 1u);
    CHECK_EQUAL(memory.actions[0], 13.0f);
    CHECK_EQUAL(memory.e[0], 6.0);
    CHECK_EQUAL(memory.priority[0], 4u);  // one insertion, three exact hits
}

TEST(update_meets_the_same_state_twice_in_one_trajectory_in_order_of_time) {
    EpisodicMemory memory(small(), 1);
    Trajectory trajectory;
    trajectory.states = {1, 2, 1};
    trajectory.actions = {10, 20, 30};
    trajectory.rewards = {0, 0, 1};
    relabel(trajectory, 1, 1, gamma_dr);
    const auto changes = memory.update(trajectory);
    CHECK(changes.inserted == 2 && changes.improved == 1 && changes.kept == 0);
    CHECK_EQUAL(memory.e[0], 1.0);
    CHECK_EQUAL(memory.actions[0], 30.0f);
    CHECK_EQUAL(memory.e[1], 0.99);
}

TEST(states_match_by_bits_except_that_minus_zero_is_zero) {
    EpisodicMemory memory =
        table_of(small(), {{-0.0f, 1, 1}, {0.0f, 2, 2}, {1.0f, 3, 3}, {std::nextafter(1.0f, 2.0f), 4, 4}});
    CHECK_EQUAL(memory.size(), size_t{3});
    CHECK_EQUAL(memory.e[0], 2.0);
    CHECK(!std::signbit(memory.projected[0]));
    std::set<Words4> keys;
    const std::vector<float> zeros(9, 0.0f);
    for (size_t dim = 1; dim <= 9; ++dim)
        keys.insert(state_key(zeros.data(), dim));  // the dimension is part of the key
    for (size_t d = 0; d < 9; ++d) {
        std::vector<float> state = zeros;
        for (state[d] = 1.0f; state[d] < 9.0f; ++state[d]) keys.insert(state_key(state.data(), 9));
    }
    CHECK_EQUAL(keys.size(), size_t{9 + 9 * 8});
}

TEST(a_refused_trajectory_or_query_leaves_the_table_as_it_was) {
    EpisodicMemory memory = table_of(small(), {{1, 1, 1}});
    Trajectory bad = with_return(3, 1);
    bad.states[2] = NAN;
    CHECK_FAILS("memory.not_finite", memory.update(bad));
    bad = with_return(3, 1);
    bad.discounted_returns.clear();
    CHECK_FAILS("memory.shape", memory.update(bad));
    const float evil = INFINITY;
    CHECK_FAILS("memory.not_finite", search_and_count(memory, &evil));
    CHECK(memory.size() == 1 && memory.accesses == 1);
    MemoryConfig wrong = small();
    CHECK_FAILS("memory.config", wrong.K = 0; EpisodicMemory(wrong, 1));
    CHECK_FAILS("memory.config", wrong = small(); wrong.capacity = 0; EpisodicMemory(wrong, 1));
    CHECK_FAILS("memory.config", wrong = small(); wrong.tau = NAN; EpisodicMemory(wrong, 1));
}

// WODTEM sec. IV-B.1, full table test
TEST(a_full_table_forgets_the_least_frequently_or_least_recently_used) {
    MemoryConfig config = small();
    config.capacity = 3;
    for (const Eviction eviction : {Eviction::lfu, Eviction::lru}) {
        config.eviction = eviction;
        // Accesses: state 1 three times but long ago, state 2 twice and last, state 3 once.
        EpisodicMemory memory = table_of(config, {{1, 0, 0}, {1, 0, 0}, {1, 0, 0}, {3, 0, 0}, {2, 0, 0}, {2, 0, 0}});
        CHECK_EQUAL(memory.update(one_step({4}, 0, 0)).evicted, 1u);
        const std::vector<float> after = memory.projected;
        CHECK(after == (eviction == Eviction::lfu ? std::vector<float>{1, 4, 2} : std::vector<float>{4, 3, 2}));
    }
    config.eviction = Eviction::lfu;
    EpisodicMemory tied = table_of(config, {{1, 0, 0}, {2, 0, 0}, {3, 0, 0}, {4, 0, 0}, {5, 0, 0}});
    CHECK(tied.projected == (std::vector<float>{4, 5, 3}));  // ties: the oldest goes
    config.capacity = 1;
    CHECK(table_of(config, {{1, 0, 0}, {1, 0, 0}, {2, 0, 0}, {3, 0, 0}}).projected == std::vector<float>{3});
}

// WODTEM eq. (4) test; WODTEM sec. IV-B.1, full table test
TEST(table_agrees_with_a_naive_map_over_random_operations) {
    MemoryConfig config = {.state_dim = 2, .action_dim = 1, .projected_dim = 0, .capacity = 60, .K = 3, .epsilon = 0.5};
    compare_with_naive(config, 100000, 1);
    config.eviction = Eviction::lru;
    compare_with_naive(config, 100000, 2);
    config.exclude_self = true;
    config.capacity = 7;
    compare_with_naive(config, 50000, 3);
}

TEST(two_million_entries_fit_in_400_megabytes) {
    // One sixteenth of it: the hash table is a power of two in both cases, everything else is proportional.
    EpisodicMemory memory(
        {.state_dim = 11, .action_dim = 8, .projected_dim = 4, .capacity = 125000, .K = 2, .epsilon = 0.1}, 1);
    Trajectory trajectory;
    trajectory.states.resize(11 * 125001);
    for (size_t t = 0; t <= 125000; ++t) trajectory.states[11 * t + t % 11] = static_cast<float>(t + 1);
    trajectory.actions.resize(8 * 125001);
    trajectory.rewards.resize(125001);
    relabel(trajectory, 11, 8, gamma_dr);
    CHECK_EQUAL(memory.update(trajectory).evicted, 1u);
    CHECK(memory_bytes(memory) * 16 > 250000000 && memory_bytes(memory) * 16 < 370000000);
}

// ---- Neighbours

// WODTEM sec. IV-B.2, K(s_q) test
TEST(the_tree_finds_what_a_linear_scan_finds) {
    const Random random{test_seed(), Stream::data_set};
    struct Case {
        int dim, projected_dim;
        size_t capacity;
        int K;
        double epsilon;
    };
    std::vector<Case> cases = {{1, 0, 1, 2, 1e9},       {2, 0, 15, 1, 1e9},        {2, 0, 16, 20, 1e9},
                               {2, 0, 17, 2, 0.1},      {3, 0, 33, 40, 1e9},       {4, 0, 3000, 2, 0.1},
                               {2, 0, 3000, 5, 1},      {7, 4, 3000, 2, 1e9},      {20, 16, 500, 3, 1e9},
                               {11, 0, 2000, 2, 1e300}, {4, 4, 300, 300, INFINITY}};
    for (int dim = 1; dim <= 64; ++dim) cases.push_back({dim, dim % 2 ? 0 : dim, 200, 1 + dim % 3, 10});
    uint64_t salt = 0;
    for (const auto& [dim, projected_dim, capacity, K, epsilon] : cases)
        for (const Shape shape :
             {Shape::uniform, Shape::lattice, Shape::clusters, Shape::walk, Shape::line, Shape::point}) {
            EpisodicMemory memory({.state_dim = dim,
                                   .action_dim = 1,
                                   .projected_dim = projected_dim,
                                   .capacity = capacity,
                                   .K = K,
                                   .epsilon = epsilon,
                                   .eviction = salt % 2 ? Eviction::lfu : Eviction::lru},
                                  test_seed());
            const auto check = [&] {
                check_tree(memory);
                compare_with_plain(memory, ++salt);
            };
            check();
            for (uint64_t i = 0; i < 2 * capacity; ++i) {  // the second half evicts
                memory.update(one_step(state_of(shape, random, dim, i), 0.0f, 0.0f));
                if (i == 0 || i == capacity / 3 || i == capacity - 1 || i == capacity + capacity / 7) check();
            }
            check();
            memory.rebuild_derived();
            check();
        }
}

// Every distance is tied with hundreds of others: the points of a one-hot grid world, each many times over, differ from
// a one-hot query by 0 or 2. The unprojected last coordinate tells the states apart but not the points.
TEST(the_tree_breaks_hundreds_of_ties_by_age) {
    const Random random{test_seed(), Stream::data_set};
    for (const int K : {1, 7, 500, 1000}) {
        EpisodicMemory memory({.state_dim = 37,
                               .action_dim = 1,
                               .projected_dim = 36,
                               .capacity = 2500,
                               .K = K,
                               .epsilon = K == 7 ? 2.0 : 3.0},
                              1);
        std::fill(memory.projection.begin(), memory.projection.end(), 0.0);
        for (size_t d = 0; d < 36; ++d) memory.projection[d * 37 + d] = 1.0;
        for (uint64_t i = 0; i < 4000; ++i) {  // the last 1,500 evict
            std::vector<float> state(37, 0.0f);
            state[random.below(36, i, 0)] = 1.0f;
            state[36] = static_cast<float>(i);
            memory.update(one_step(state, 0.0f, 0.0f));
        }
        check_tree(memory);
        compare_with_plain(memory, static_cast<uint64_t>(K));
    }
}

TEST(the_tree_survives_any_order_of_coming_and_going) {
    const Random random{test_seed(), Stream::data_set};
    EpisodicMemory memory(
        {.state_dim = 3, .action_dim = 1, .projected_dim = 0, .capacity = 4000, .K = 3, .epsilon = 1e9}, 1);
    for (uint64_t i = 0; i < 4000; ++i)
        memory.update(one_step(state_of(Shape::uniform, random, 3, i), 0.0f, static_cast<float>(i)));
    std::vector<uint32_t> inside(4000), outside;
    for (uint32_t i = 0; i < 4000; ++i) inside[i] = i;
    // Shrinks to nothing and grows again, thrice: each step takes out or puts in an entry at random.
    for (uint64_t i = 0; i < 30000; ++i) {
        const bool shrinking = (i / 5000) % 2 == 0, take = random.below(10, i, 3) < (shrinking ? 9u : 1u);
        std::vector<uint32_t>&from = take ? inside : outside, &to = take ? outside : inside;
        if (from.empty()) continue;
        std::swap(from[random.below(from.size(), i, 4)], from.back());
        if (take) memory.tree.remove(memory.points(), from.back());
        if (!take) memory.tree.insert(memory.points(), from.back());
        to.push_back(from.back());
        from.pop_back();
        if (i % 997 != 0) continue;
        check_tree(memory, inside);
        Neighbourhoods found = memory.nearest(state_of(Shape::uniform, random, 3, i), {no_entry}, memory.reach());
        std::vector<Neighbour> expected;
        const std::vector<float> point = state_of(Shape::uniform, random, 3, i);
        for (const uint32_t entry : inside)
            expected.push_back({squared_distance(&memory.projected[3 * entry], point.data(), 3), entry});
        std::sort(expected.begin(), expected.end(), [&](auto& a, auto& b) { return memory.points().closer(a, b); });
        expected.resize(std::min(expected.size(), size_t{3}));
        CHECK(same(found[0], expected));
    }
    check_tree(memory, inside);
    for (const uint32_t entry : outside) memory.tree.insert(memory.points(), entry);
    check_tree(memory);
}

TEST(many_equal_points_neither_break_nor_slow_the_tree) {
    // 20,000 states that differ only in a coordinate the projection does not see; 20,000 more evict all but 5,000.
    EpisodicMemory memory(
        {.state_dim = 3, .action_dim = 1, .projected_dim = 2, .capacity = 25000, .K = 2, .epsilon = 1}, 1);
    memory.projection = {1, 0, 0, 0, 1, 0};
    for (int i = 0; i < 45000; ++i) {
        const auto x = static_cast<float>(i);
        const bool elsewhere = i >= 20000 && i < 25000;
        memory.update(one_step(elsewhere ? std::vector<float>{x, x * 0.5f, 0} : std::vector<float>{3, 4, x}, 0, 0));
        if (i != 24999 && i != 44999) continue;
        const float at[] = {3, 4, -1}, near[] = {3.25f, 4, -1};
        const uint32_t oldest = 0;  // slots are given anew from the oldest on, so again to the first
        for (int j = 0; j < 1000; ++j)
            CHECK(entries_of(search(memory, at)) == (std::vector<uint32_t>{oldest, oldest + 1}));
        CHECK(entries_of(search(memory, near)) == (std::vector<uint32_t>{oldest, oldest + 1}));
        check_tree(memory);
    }
}

TEST(the_largest_states_overflow_to_infinite_distances_and_no_further) {
    EpisodicMemory memory(
        {.state_dim = 3, .action_dim = 1, .projected_dim = 2, .capacity = 99, .K = 3, .epsilon = INFINITY}, 1);
    const std::vector<float> high(3, 3.4e38f), low(3, -3.4e38f), zero(3, 0.0f);
    for (const auto& state : {zero, low, high}) memory.update(one_step(state, 0, 0));
    CHECK(entries_of(search(memory, high.data())) == std::vector<uint32_t>{2});  // infinity is not below infinity
    for (int i = 0; i < 90; ++i) {                                               // and the tree can still cut and part
        const float x = 3.4e38f * std::sin(static_cast<float>(i));
        memory.update(one_step({x, -x, i % 2 ? x : 0.0f}, 0, 0));
    }
    check_tree(memory);
    compare_with_plain(memory, 1);
    for (const auto& state : {zero, low, high}) {
        std::vector<float> point(2);
        memory.project(state.data(), point.data());
        CHECK(
            same(memory.nearest(point, {no_entry}, memory.reach())[0], nearest_plain(memory, point.data(), no_entry)));
    }
}

TEST(lookup_prefers_older_entry_on_tie) {
    MemoryConfig config = small();
    config.capacity = 3;
    config.K = 1;
    EpisodicMemory memory = table_of(config, {{0.5f, 0, 0}, {9, 0, 0}, {9, 0, 0}, {-0.5f, 0, 0}});
    const float zero = 0.0f;
    CHECK(entries_of(search(memory, &zero)) == std::vector<uint32_t>{0});
    memory.update(one_step({-0.5f}, 0, 0));  // now 0.5 is the least used: its slot goes to 7, then 7's to 0.5
    memory.update(one_step({7}, 0, 0));
    memory.update(one_step({0.5f}, 0, 0));
    CHECK_EQUAL(memory.projected[0], 0.5f);
    CHECK(entries_of(search(memory, &zero)) == std::vector<uint32_t>{2});  // older, though in a later slot
}

// WODTEM sec. IV-B.2, K(s_q) test; WODTEM sec. IV-B.2, q test
TEST(neighbours_lie_strictly_within_epsilon) {
    MemoryConfig config = small();
    const float zero = 0.0f;
    CHECK_EQUAL(search(EpisodicMemory(config, 1), &zero).size(), size_t{0});  // empty table
    config.K = 5;
    config.epsilon = 0.25;
    EpisodicMemory memory =
        table_of(config, {{0.5f, 0, 0}, {std::nextafter(0.5f, 0.0f), 0, 0}, {-0.25f, 0, 0}, {0.75f, 0, 0}});
    const auto found = search_and_count(memory, &zero);  // 0.5 is at 0.25 exactly: out; K exceeds the entries
    CHECK(entries_of(found) == (std::vector<uint32_t>{2, 1}));
    memory.config.epsilon = 0.25 + 1e-12;  // no float, and the one below it is 0.25
    CHECK(entries_of(search(memory, &zero)) == (std::vector<uint32_t>{2, 1, 0}));
    memory.config.epsilon = 0.25 - 1e-12;
    CHECK(entries_of(search(memory, &zero)) == (std::vector<uint32_t>{2, 1}));
    CHECK_EQUAL(found[0].distance, 0.0625f);                        // the distance is squared
    CHECK(memory.priority == (std::vector<uint64_t>{1, 2, 2, 1}));  // who passed epsilon was accessed
    memory.config.exclude_self = true;
    const float own = -0.25f;
    CHECK(entries_of(search(memory, &own)).empty());
    const float two[] = {-0.25f, 0.75f};  // each query excludes its own entry
    const Neighbourhoods both = memory.search(two, 2);
    CHECK(entries_of({both[1].begin(), both[1].end()}) == (std::vector<uint32_t>{0, 1}));
    memory.config.exclude_self = false;
    CHECK(entries_of(search(memory, &own)) == std::vector<uint32_t>{2});
}

// WODTEM sec. IV-B.1, projection test
TEST(projection_keeps_squared_lengths_on_average_and_depends_on_the_seed) {
    std::vector<float> state(50, 1.0f);
    double mean = 0.0;
    for (uint32_t seed = 0; seed < 400; ++seed) {
        const EpisodicMemory memory(
            {.state_dim = 50, .action_dim = 1, .projected_dim = 4, .capacity = 1, .K = 1, .epsilon = 1}, seed);
        const std::vector<float> origin(4, 0.0f);
        std::vector<float> point(4);
        memory.project(state.data(), point.data());
        mean += squared_distance(point.data(), origin.data(), 4) / 400.0;
    }
    CHECK_CLOSE(mean, 50.0,
                5 * 50 * std::sqrt(0.5 / 400));  // |P s|^2 / |s|^2 is a chi-square of 4 over 4: variance 1/2
}

// ---- Equations (5) to (7)

// WODTEM eq. (5) test
TEST(approximate_return_weighs_by_exp_of_minus_squared_distance) {
    EpisodicMemory memory = table_of(small(), {{0.0f, 0, 10}, {0.5f, 0, 20}});
    const float query = 0.125f;  // squared distances 1/64 and 9/64
    const auto found = search_and_count(memory, &query);
    const double a = std::exp(-1.0 / 64), b = std::exp(-9.0 / 64);
    CHECK_CLOSE(approximate_return(memory, found), (a * 10 + b * 20) / (a + b), 1e-5);
    CHECK_EQUAL(approximate_return(memory, std::span(found).first(1)), 10.0);
    const std::vector<Neighbour> far = {{400, 0}, {400, 1}};
    CHECK_CLOSE(approximate_return(memory, far), 15.0, 1e-12);  // exp(-400) is 0 in float
}

// WODTEM eq. (6) test
TEST(advised_action_follows_the_softmax_of_returns) {
    EpisodicMemory memory = table_of(small(), {{0.0f, 100, 1}, {0.25f, 200, 2}});
    const float query = 0.0f;
    const auto found = search_and_count(memory, &query);
    const double first = 1.0 / (1.0 + std::exp(1.0));  // p of the entry with e = 1
    CHECK_EQUAL(*memory.advised_action(found, 0.0), 100.0f);
    CHECK_EQUAL(*memory.advised_action(found, first - 1e-6), 100.0f);
    CHECK_EQUAL(*memory.advised_action(found, first + 1e-6), 200.0f);
    CHECK_EQUAL(*memory.advised_action(found, 1.0 - 0x1p-53), 200.0f);
    memory.config.tau = 0.5;
    const double colder = 1.0 / (1.0 + std::exp(2.0));
    CHECK_EQUAL(*memory.advised_action(found, colder - 1e-6), 100.0f);
    CHECK_EQUAL(*memory.advised_action(found, colder + 1e-6), 200.0f);
    CHECK_FAILS("memory.no_neighbours", memory.advised_action({}, 0.5));
}

TEST(advised_action_survives_large_returns_and_never_draws_probability_zero) {
    EpisodicMemory memory = table_of(small(), {{0.0f, 100, 0}, {0.25f, 200, 3000}, {0.5f, 300, -3000}});
    const std::vector<Neighbour> found = {{0, 0}, {0, 1}, {0, 2}};
    for (const double uniform : {0.0, 0.5, 1.0 - 0x1p-53}) CHECK_EQUAL(*memory.advised_action(found, uniform), 200.0f);
    const std::vector<Neighbour> equal(7, Neighbour{0, 1});
    CHECK_EQUAL(*memory.advised_action(equal, 1.0 - 0x1p-53), 200.0f);
}

// WODTEM eq. (7) test
TEST(weight_is_alpha_only_below_the_approximate_return) {
    const EpisodicMemory memory = table_of(small(), {{0.0f, 0, 0.1f}, {0.3f, 0, 0.1f}, {0.5f, 0, 4.0f}});
    const double e = memory.e[0];
    const std::vector<Neighbour> lone = {{0, 0}}, two = {{0.0f, 0}, {0.09f, 1}}, far = {{0.0f, 0}, {0.25f, 2}};
    for (const auto& found : {lone, two}) {
        CHECK_EQUAL(memory.weight(memory.is_optimal(found, e), 0.9), 1.0);  // equal, whatever the rounding of the mean
        CHECK_EQUAL(memory.weight(memory.is_optimal(found, std::nextafter(e, 1.0)), 0.9), 1.0);
        CHECK_EQUAL(memory.weight(memory.is_optimal(found, std::nextafter(e, 0.0)), 0.9), 0.9);
    }
    const double mean = approximate_return(memory, far);
    CHECK_EQUAL(memory.weight(memory.is_optimal(far, mean + 1e-9), 0.75), 1.0);
    CHECK_EQUAL(memory.weight(memory.is_optimal(far, mean - 1e-9), 0.75), 0.75);
    CHECK_EQUAL(memory.weight(memory.is_optimal(lone, 0.0), 0.0), 0.0);
    CHECK_EQUAL(memory.weight(memory.is_optimal(lone, 0.0), 1.0), 1.0);
    CHECK_EQUAL(memory.weight(memory.is_optimal({}, -1e9), 0.9), 1.0);  // no neighbours: plain ODT
}

// ---- Saving and loading

TEST(a_loaded_memory_continues_like_the_one_that_was_saved) {
    for (const Eviction eviction : {Eviction::lfu, Eviction::lru}) {
        MemoryConfig config = {
            .state_dim = 5, .action_dim = 1, .projected_dim = 2, .capacity = 300, .K = 3, .epsilon = 2};
        config.eviction = eviction;
        EpisodicMemory saved(config, 7), loaded(config, 8);  // the projection is saved too
        const Random random{test_seed(), Stream::data_set};
        const auto advance = [&](EpisodicMemory& memory, uint64_t i) {
            std::vector<float> state;
            for (uint32_t d = 0; d < 5; ++d) state.push_back(static_cast<float>(random.below(3, i, d)));
            if (i % 2) memory.update(one_step(state, static_cast<float>(i), random.normal(i, 9)));
            return search_and_count(memory, state.data());
        };
        for (uint64_t i = 0; i < 3000; ++i) advance(saved, i);
        ToyArchive archive;
        visit_memory(archive, saved, 0);
        archive.loading = true;
        visit_memory(archive, loaded, 0);
        for (uint64_t i = 3000; i < 6000; ++i) CHECK(same(advance(saved, i), advance(loaded, i)));
        ToyArchive first, second;
        visit_memory(first, saved, 0);
        visit_memory(second, loaded, 0);
        CHECK(first.fields == second.fields && first.fields.size() == 9);
    }
}

TEST(a_damaged_memory_is_refused) {
    EpisodicMemory memory = table_of(small(), {{1, 1, 1}, {2, 2, 2}, {3, 3, 3}});
    ToyArchive good;
    visit_memory(good, memory, 0);
    good.loading = true;
    const auto check_refused = [&](const char* field, const auto& damage) {
        ToyArchive bad = good;
        damage(bad.fields[field]);
        CHECK_FAILS("checkpoint.entry", visit_memory(bad, memory, 0));
    };
    check_refused("memory.e", [](auto& bytes) { bytes.resize(16); });
    check_refused("memory.e", [](auto& bytes) { bytes[6] = 0xF0, bytes[7] = 0x7F; });  // infinity
    check_refused("memory.keys", [](auto& bytes) { bytes.assign(48, 0); });
    check_refused("memory.age", [](auto& bytes) { bytes[0] = 2; });
    check_refused("memory.age", [](auto& bytes) { bytes[0] = 9; });
    check_refused("memory.priority", [](auto& bytes) { bytes[0] = 0; });
    check_refused("memory.projection", [](auto& bytes) { bytes.resize(8); });
    visit_memory(good, memory, 4);
    for (const int moves : {1, 3}) CHECK_FAILS("checkpoint.entry", visit_memory(good, memory, moves));
    memory.config.capacity = 2;
    CHECK_FAILS("checkpoint.entry", visit_memory(good, memory, 0));
}

TEST(a_loaded_replay_buffer_continues_like_the_one_that_was_saved) {
    ReplayBuffer saved{.state_dim = 1, .action_dim = 1, .gamma = gamma_dr, .capacity = 3}, loaded = saved;
    saved.start({with_return(3, 1), with_return(4, 2), with_return(5, 3)});
    saved.trajectories[1].terminated = true;
    saved.add(with_return(2, 7));
    ToyArchive archive;
    visit_replay(archive, saved, 0);
    archive.loading = true;
    visit_replay(archive, loaded, 0);
    for (ReplayBuffer* replay : {&saved, &loaded}) replay->add(with_return(9, 4));
    const Random random{test_seed(), Stream::batch};
    for (uint32_t i = 0; i < 100; ++i) {
        const Window a = saved.sample(random, 0, i, 4, Sampling::uniform),
                     b = loaded.sample(random, 0, i, 4, Sampling::uniform);
        CHECK(a.trajectory == b.trajectory && a.start == b.start && a.length == b.length);
    }
    for (size_t i = 0; i < 3; ++i) {
        CHECK(saved.trajectories[i].discounted_returns == loaded.trajectories[i].discounted_returns);
        CHECK(saved.trajectories[i].terminated == loaded.trajectories[i].terminated);
    }
    CHECK_FAILS("checkpoint.entry", ToyArchive bad = archive; bad.fields["replay.lengths"][0] = 1;
                visit_replay(bad, loaded, 0));
    CHECK_FAILS("checkpoint.entry", ToyArchive bad = archive; bad.fields["replay.next"][0] = 3;
                visit_replay(bad, loaded, 0));
    CHECK_FAILS("checkpoint.entry", ToyArchive bad = archive; bad.fields["replay.states"].pop_back();
                bad.fields["replay.states"].resize(4); visit_replay(bad, loaded, 0));
}
