// memory.hpp: what the agent remembers: trajectories and their returns, the replay buffer D, the episodic memory Q.
//   sec. III-A      g_t and d_t                     returns_to_go, discounted_returns, relabel
//   sec. III-A      D_offline, D_online             offline_set, ReplayBuffer
//   sec. IV-B.1     the table Q, eq. (4)            EpisodicMemory::update    (the paper's rule between (3) and (5))
//   sec. IV-B.2     K(s_q), eqs. (5) and (6)        nearest, search, is_optimal, advised_action
//   sec. IV-B.3     eq. (7)                         weight
// Promises: exact nearest neighbours; every tie has a stated winner, so results depend on the order of updates and
// look-ups and on nothing else (not on when the search tree was built, not on a save and load in between); a refused
// trajectory leaves the table as it was. Leaves out: networks, files, threads (many threads may call search() at once).
//
// Memory per entry, with projected_dim 4 and action_dim 8: 88 bytes are saved (key 16, projected state 16, action 32,
// e 8, priority 8, age 8); the hash table, the eviction heap and the search tree are derived from them and take about as
// much again. The raw state is not kept. Times of a look-up, an insertion and an eviction: tests/BENCH.md.
#pragma once

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstdint>
#include <limits>
#include <span>
#include <utility>
#include <vector>

#include "nn.hpp"

// The streams of random numbers beside those of nn.hpp. The values are part of the format of a run; never renumber.
namespace Stream {
constexpr uint32_t batch = 3;              // step: update; index: window of the batch
constexpr uint32_t exploration = 4;        // step: episode; site: action dimension; index: time-step
constexpr uint32_t remembered_action = 5;  // eq. (6). step: update; index: window * context_length + step in the window
constexpr uint32_t entropy_noise = 6;      // the same; site: action dimension
constexpr uint32_t environment = 7;  // step: episode (evaluations from 2^40, data sets from 2^41); index: draw in reset
constexpr uint32_t projection = 8;   // step: 0; index: element of the random projection
constexpr uint32_t data_set = 9;     // step: trajectory; index: time-step; site: action dimension
}  // namespace Stream

// ---------------------------------------------------------------------------------------------------------------------
// Trajectories and their returns. T is the number of steps, t counts from 1 in the paper and from 0 in arrays.

struct Trajectory {
    std::vector<float> states;               // [T, state_dim]
    std::vector<float> actions;              // [T, action_dim]; a discrete action is one float: its index
    std::vector<float> rewards;              // [T] raw: neither scaled nor clipped
    bool terminated = false;                 // false: cut by the time limit
    std::vector<double> returns_to_go;       // [T] g_t, filled by relabel()
    std::vector<double> discounted_returns;  // [T] d_t, filled by relabel()

    int length() const { return static_cast<int>(rewards.size()); }
};

// WODTEM sec. III-A, d_t: d_t = sum_{t'=t..T} gamma^(t'-t) r_t', backwards as d_t = r_t + gamma d_{t+1}, d_{T+1} = 0.
// A plain sum to the last step, also when the time limit cut the trajectory: nothing is bootstrapped.
inline std::vector<double> discounted_returns(const std::vector<float>& rewards, double gamma) {
    std::vector<double> d(rewards.size());
    double next = 0.0;
    for (size_t t = rewards.size(); t-- > 0;) d[t] = next = rewards[t] + gamma * next;
    return d;
}

// WODTEM sec. III-A, g_t: g_t = sum_{t'=t..T} r_t', which is d_t with gamma = 1.
// departs from ODT's code: summed in double, not in float32, so that the order of additions hardly matters.
inline std::vector<double> returns_to_go(const std::vector<float>& rewards) { return discounted_returns(rewards, 1.0); }

template <class Number>
void check_finite(const char* what, const Number* values, size_t count) {
    for (size_t i = 0; i < count; ++i)
        if (!std::isfinite(values[i]))
            fail("memory.not_finite", "%s[%zu] is %g; only finite numbers can be remembered", what, i,
                 static_cast<double>(values[i]));
}

inline void check_size(const char* what, size_t got, size_t steps, size_t width) {
    if (got != steps * width)
        fail("memory.shape", "%zu %s for %zu steps, expected %zu", got, what, steps, steps * width);
}

// Validates a trajectory and computes both returns from its rewards; targets used while acting play no part.
inline void relabel(Trajectory& trajectory, int state_dim, int action_dim, double gamma) {
    const size_t T = trajectory.rewards.size();
    if (T == 0) fail("memory.shape", "a trajectory has no steps, expected at least one");
    check_size("states", trajectory.states.size(), T, static_cast<size_t>(state_dim));
    check_size("actions", trajectory.actions.size(), T, static_cast<size_t>(action_dim));
    check_finite("states", trajectory.states.data(), trajectory.states.size());
    check_finite("actions", trajectory.actions.data(), trajectory.actions.size());
    check_finite("rewards", trajectory.rewards.data(), T);
    trajectory.returns_to_go = returns_to_go(trajectory.rewards);
    trajectory.discounted_returns = discounted_returns(trajectory.rewards, gamma);
}

// WODTEM sec. III-A: the total return is g_1.
inline double total_return(const Trajectory& trajectory) {
    if (trajectory.returns_to_go.empty())
        fail("memory.not_relabelled", "a trajectory has no returns: relabel it first");
    return trajectory.returns_to_go.front();
}

inline bool lower_return(const Trajectory& a, const Trajectory& b) { return total_return(a) < total_return(b); }

// ODT's loop that keeps trajectories, best first, stops one short: exactly the lowest-return one is dropped, unless it
// is the only one. Of several lowest, the first in the data set goes. The others stay in the order of the data set.
inline std::vector<Trajectory> offline_set(std::vector<Trajectory> trajectories, bool keep_lowest) {
    if (!keep_lowest && trajectories.size() > 1)
        trajectories.erase(std::min_element(trajectories.begin(), trajectories.end(), lower_return));
    return trajectories;
}

// ---------------------------------------------------------------------------------------------------------------------
// Replay buffer: D_offline when capacity is the size of the offline set, D_online otherwise.

struct Window {
    size_t trajectory;
    int start, length;  // steps; start counts from 0
};

struct ReplayBuffer {
    int state_dim, action_dim;
    double gamma;
    size_t capacity;                            // trajectories
    std::vector<Trajectory> trajectories = {};  // relabelled
    uint64_t next = 0;                          // the one to be overwritten next, once full
    std::vector<uint64_t> ends = {};            // derived: ends[i] = steps in trajectories 0..i

    // The `capacity` trajectories with the highest returns, sorted from low to high; of equal returns the later in the
    // data set counts as higher. So "first in, first out" begins with the worst offline trajectory, as in ODT's code.
    void start(std::vector<Trajectory> candidates) {
        std::stable_sort(candidates.begin(), candidates.end(), lower_return);
        if (candidates.size() > capacity)
            candidates.erase(candidates.begin(), candidates.end() - static_cast<std::ptrdiff_t>(capacity));
        trajectories = std::move(candidates);
        next = 0;
        count_steps();
    }

    // WODTEM sec. III-A, D_online: first in, first out: append until full, then overwrite from index 0 upwards, lap
    // after lap.
    void add(Trajectory trajectory) {
        if (trajectories.size() < capacity) {
            trajectories.push_back(std::move(trajectory));
        } else {
            trajectories[next] = std::move(trajectory);
            next = (next + 1) % capacity;
        }
        count_steps();
    }

    void count_steps() {
        ends.clear();
        for (const Trajectory& trajectory : trajectories)
            ends.push_back((ends.empty() ? 0 : ends.back()) + static_cast<uint64_t>(trajectory.length()));
    }

    // WODTEM sec. III-B, C^t: the steps of a sub-trajectory. A trajectory is drawn with probability proportional to its
    // length and a start uniformly from its steps; the window is the next min(context_length, steps left) steps. So
    // windows that start near the end of a trajectory are short.
    // departs from the paper: as ODT's code does, not the latest C steps up to t, which are short at the beginning.
    // One number drawn from all steps laid end to end has exactly these probabilities, for each step is one start.
    Window sample(const Random& random, uint64_t update, uint32_t window_index, int context_length) const {
        if (trajectories.empty()) fail("replay.empty", "cannot sample: the replay buffer holds no trajectory");
        return window_at(random.below(ends.back(), update, window_index), context_length);
    }

    // The window that starts at a step, 0 <= step < ends.back(), of all trajectories laid end to end.
    Window window_at(uint64_t step, int context_length) const {
        const auto end = std::upper_bound(ends.begin(), ends.end(), step);  // the first trajectory to end after `step`
        const int left = static_cast<int>(*end - step);
        const auto trajectory = static_cast<size_t>(end - ends.begin());
        return {trajectory, trajectories[trajectory].length() - left, std::min(context_length, left)};
    }

    // Saved packed: trajectories laid end to end. `archive(name, field)` writes or, when archive.loading, reads.
    template <class Archive>
    void visit(Archive& archive) {
        std::vector<float> states, actions, rewards;
        std::vector<uint32_t> lengths, terminated;
        const auto append = [](auto& all, const auto& part) { all.insert(all.end(), part.begin(), part.end()); };
        for (const Trajectory& trajectory : trajectories) {
            if (archive.loading) break;
            append(states, trajectory.states);
            append(actions, trajectory.actions);
            append(rewards, trajectory.rewards);
            lengths.push_back(static_cast<uint32_t>(trajectory.length()));
            terminated.push_back(trajectory.terminated);
        }
        archive("replay.states", states);
        archive("replay.actions", actions);
        archive("replay.rewards", rewards);
        archive("replay.lengths", lengths);
        archive("replay.terminated", terminated);
        archive("replay.next", next);
        if (archive.loading) unpack(states, actions, rewards, lengths, terminated);
    }

    void unpack(const std::vector<float>& states, const std::vector<float>& actions, const std::vector<float>& rewards,
                const std::vector<uint32_t>& lengths, const std::vector<uint32_t>& terminated) {
        const auto S = static_cast<size_t>(state_dim), A = static_cast<size_t>(action_dim);
        size_t steps = 0;
        for (const uint32_t length : lengths) steps += length;
        if (lengths.size() != terminated.size() || lengths.size() > capacity || steps != rewards.size() ||
            states.size() != steps * S || actions.size() != steps * A || next >= std::max<size_t>(capacity, 1) ||
            (lengths.size() < capacity && next != 0))
            fail("checkpoint.replay",
                 "the replay buffer does not fit together: %zu trajectories of %zu steps in all (at most %zu "
                 "trajectories), %zu flags, %zu states of %zu, %zu actions of %zu, %zu rewards, next %zu",
                 lengths.size(), steps, capacity, terminated.size(), states.size(), S, actions.size(), A,
                 rewards.size(), static_cast<size_t>(next));
        trajectories.clear();
        const auto slice = [](const std::vector<float>& all, size_t first, size_t count) {
            return std::vector<float>(all.data() + first, all.data() + first + count);
        };
        for (size_t i = 0, t = 0; i < lengths.size(); t += lengths[i], ++i) {
            const size_t T = lengths[i];
            Trajectory trajectory;
            trajectory.states = slice(states, t * S, T * S);
            trajectory.actions = slice(actions, t * A, T * A);
            trajectory.rewards = slice(rewards, t, T);
            trajectory.terminated = terminated[i] != 0;
            relabel(trajectory, state_dim, action_dim, gamma);
            trajectories.push_back(std::move(trajectory));
        }
        count_steps();
    }
};

// ---------------------------------------------------------------------------------------------------------------------
// Exact nearest neighbours. Distances are squared, in float32, summed in the order of the dimensions.

constexpr uint32_t no_entry = 0xFFFFFFFF;

struct Neighbour {
    float distance;  // q(s_q, s_k) = ||s_q - s_k||^2, in the projected space
    uint32_t entry;
};

// WODTEM sec. IV-B.2, q: q(s_q, s_k) = ||s_q - s_k||^2, not its root.
inline float squared_distance(const float* a, const float* b, size_t dim) {
    float sum = 0.0f;
    for (size_t d = 0; d < dim; ++d) sum += (a[d] - b[d]) * (a[d] - b[d]);
    return sum;
}

// K(s_q) of many queries s_q.
struct Neighbourhoods {
    size_t K = 0;
    std::vector<Neighbour> rows = {};  // [query, K], closest first
    std::vector<size_t> counts = {};   // [query] how many of a row are in use

    size_t size() const { return counts.size(); }
    std::span<const Neighbour> operator[](size_t i) const { return {rows.data() + i * K, counts[i]}; }
};

// What the tree reads of the table. An age is an insertion number: smaller is older, and no two are equal.
struct Points {
    const float* rows;     // [entry, dim]
    const uint64_t* ages;  // [entry]

    // The order of neighbours. Ties: smaller distance, then older entry.
    bool closer(const Neighbour& a, const Neighbour& b) const {
        return a.distance < b.distance || (a.distance == b.distance && ages[a.entry] < ages[b.entry]);
    }
};

// A bucket k-d tree (Friedman, Bentley and Finkel, 1977) that grows and shrinks with the table. An inner node parts its
// entries by a plane: coordinate `dim` is at most `split` below its low child and at least `split` below its high child.
// Equal coordinates may thus lie on both sides, and identical points can be divided like any others. A leaf holds up to
// 16 entries; their coordinates lie side by side, so that one pass of vector code gives all distances. A node with a
// child of more than 3/4 of its entries, or with too few entries for two leaves, is built anew. So no path is longer
// than about log(n) / log(4/3), whatever the order of insertions and removals. No result depends on the tree's shape.
struct KdTree {
    static constexpr uint32_t lanes = 16;         // entries in a full leaf
    static constexpr uint32_t leaf = 0xFFFFFFFF;  // stands for `dim` in a leaf
    static constexpr size_t longest_path = 96;    // log(2^31) / log(4/3) = 75, and some for rounding

    template <class Number>
    struct alignas(64) Lanes : std::array<Number, lanes> {};
    struct Node {
        uint32_t child;  // inner node: its low child, the high child follows it. Leaf: its place in the arrays below
        uint32_t dim;
        float split;
        uint32_t count;  // entries below
    };
    using Ranked = std::pair<float, uint32_t>;  // (coordinate, entry)

    size_t dim = 0;
    std::vector<Node> nodes;                // nodes 2 p and 2 p + 1, a pair, are siblings; node 0 is the root
    std::vector<uint32_t> parents;          // [pair]
    std::vector<Lanes<float>> coordinates;  // [place, dim]
    std::vector<Lanes<uint32_t>> entries;   // [place] there is one place for each pair
    std::vector<uint32_t> home;             // [entry] the node of its leaf
    std::vector<uint32_t> free_pairs;

    // A tree of the table's first n entries.
    void build(const Points& points, size_t point_dim, uint32_t n) {
        *this = {};
        dim = point_dim;
        std::vector<Ranked> order(n);
        for (uint32_t i = 0; i < n; ++i) order[i].second = i;
        take_pair();
        build_node(points, 0, 0, order);
    }

    // Halves the entries by the dimension of the largest extent until they fit leaves. The low child gets the node's
    // place and the high child that of the new pair; so a subtree that is built anew needs no place from elsewhere.
    void build_node(const Points& points, uint32_t node, uint32_t place, std::span<Ranked> order) {
        nodes[node] = {place, leaf, 0.0f, 0};
        if (order.size() <= lanes) {
            for (const Ranked& ranked : order) put(points, node, ranked.second);
            return;
        }
        uint32_t widest = 0;
        float extent = -1.0f;
        for (uint32_t d = 0; d < dim; ++d) {
            for (Ranked& ranked : order) ranked.first = points.rows[ranked.second * dim + d];
            const auto [least, most] = std::minmax_element(order.begin(), order.end());
            if (most->first - least->first > extent) widest = d;
            extent = std::max(extent, most->first - least->first);
        }
        for (Ranked& ranked : order) ranked.first = points.rows[ranked.second * dim + widest];
        const size_t half = order.size() / 2;
        std::nth_element(order.begin(), order.begin() + static_cast<ptrdiff_t>(half), order.end());
        const uint32_t pair = take_pair(), low = 2 * pair;
        parents[pair] = node;
        nodes[node] = {low, widest, order[half].first, static_cast<uint32_t>(order.size())};
        build_node(points, low, place, order.first(half));
        build_node(points, low + 1, pair, order.subspan(half));
    }

    uint32_t take_pair() {
        if (free_pairs.empty()) {
            const size_t pairs = parents.size() + 1;
            free_pairs.push_back(static_cast<uint32_t>(pairs - 1));
            nodes.resize(2 * pairs);
            parents.resize(pairs);
            coordinates.resize(pairs * dim);
            entries.resize(pairs);
        }
        const uint32_t pair = free_pairs.back();
        free_pairs.pop_back();
        return pair;
    }

    void put(const Points& points, uint32_t node, uint32_t entry) {
        const uint32_t place = nodes[node].child, lane = nodes[node].count++;
        for (size_t d = 0; d < dim; ++d) coordinates[place * dim + d][lane] = points.rows[entry * dim + d];
        entries[place][lane] = entry;
        if (entry >= home.size()) home.resize(entry + 1);
        home[entry] = node;
    }

    bool unbalanced(uint32_t node) const {
        const auto [child, plane_dim, split, n] = nodes[node];
        return plane_dim != leaf &&
               (n <= lanes / 2 || std::max(nodes[child].count, nodes[child + 1].count) > n - n / 4);
    }

    void insert(const Points& points, uint32_t entry) {
        uint32_t node = 0;
        while (nodes[node].dim != leaf && !unbalanced(node)) {
            const auto [low, plane_dim, split, n] = nodes[node];
            const float x = points.rows[entry * dim + plane_dim];
            ++nodes[node].count;
            node = low + (x == split ? nodes[low + 1].count < nodes[low].count : x > split);
        }
        if (nodes[node].dim == leaf && nodes[node].count < lanes) return put(points, node, entry);
        rebuild(points, node, {{0.0f, entry}});
    }

    void remove(const Points& points, uint32_t entry) {
        uint32_t node = home[entry], highest = no_entry;  // the highest unbalanced node
        const uint32_t place = nodes[node].child, last = --nodes[node].count;
        const auto lane = std::find(entries[place].begin(), entries[place].end(), entry) - entries[place].begin();
        entries[place][lane] = entries[place][last];
        for (size_t d = 0; d < dim; ++d) coordinates[place * dim + d][lane] = coordinates[place * dim + d][last];
        while (node != 0) {
            node = parents[node / 2];
            --nodes[node].count;
            if (unbalanced(node)) highest = node;
        }
        if (highest != no_entry) rebuild(points, highest, {});
    }

    // Builds a node anew, from the entries below it and those in `order`.
    void rebuild(const Points& points, uint32_t node, std::vector<Ranked> order) {
        const uint32_t place = take_apart(node, order);
        build_node(points, node, place, order);
    }

    // Appends the entries below a node to `order` and frees the pairs below. Returns the place that the node was given.
    uint32_t take_apart(uint32_t node, std::vector<Ranked>& order) {
        const auto [child, plane_dim, split, n] = nodes[node];
        if (plane_dim == leaf) {
            for (uint32_t i = 0; i < n; ++i) order.push_back({0.0f, entries[child][i]});
            return child;
        }
        free_pairs.push_back(child / 2);
        const uint32_t place = take_apart(child, order);
        take_apart(child + 1, order);
        return place;
    }

    struct Walk {              // a query on its way through the tree
        size_t query;          // its number
        float reach;           // an entry farther away cannot be a neighbour
        uint32_t node = 0;     // to be visited next
        bool fetched = false;  // `node` is a leaf that has been prefetched
        size_t waiting = 0;
        std::array<Ranked, longest_path> subtrees = {};  // [waiting] passed by: (squared distance to the plane, node)
    };

    // K(s_q) of the queries `at` [query, dim], but only of entries nearer than `limit`. Sixteen walks take one step each
    // in turn, so that the next node of a walk can come from memory while the others compute.
    EACH_TARGET void search(const Points& points, const float* at, const uint32_t* skipped, float limit,
                            Neighbourhoods& found) const {
        std::vector<Walk> walks;
        for (size_t i = 0; i < std::min<size_t>(found.size(), 16); ++i) walks.push_back({i, limit});
        for (size_t left = found.size(), begun = walks.size(); left > 0;)
            for (Walk& walk : walks) {
                if (walk.query >= found.size() || step(points, at, skipped, walk, found)) continue;
                walk.query = begun++;
                walk.reach = limit;
                walk.node = 0;
                --left;
            }
    }

    // Visits one node; returns whether there is another to visit. A subtree beyond a plane can be left out if the plane
    // is too far: a point beyond has a coordinate at least that far, and rounding, being monotone, keeps that order in
    // the difference, in its square and in a sum of squares. At equal distances the older entry wins: hence <=.
    [[gnu::always_inline]] inline bool step(const Points& points, const float* at, const uint32_t* skipped, Walk& walk,
                                            Neighbourhoods& found) const {
        const Node& node = nodes[walk.node];
        if (node.dim != leaf) {
            const float gap = at[walk.query * dim + node.dim] - node.split;
            walk.node = gap > 0.0f ? node.child + 1 : node.child;
            __builtin_prefetch(&nodes[walk.node]);
            if (gap * gap <= walk.reach) walk.subtrees[walk.waiting++] = {gap * gap, walk.node ^ 1};
            return true;
        }
        if (!walk.fetched) {
            for (size_t d = 0; d < dim; ++d) __builtin_prefetch(&coordinates[node.child * dim + d]);
            __builtin_prefetch(&entries[node.child]);
            return walk.fetched = true;
        }
        scan(points, at + walk.query * dim, skipped[walk.query], node, walk, found);
        walk.fetched = false;
        while (walk.waiting > 0) {
            const auto [distance, subtree] = walk.subtrees[--walk.waiting];
            walk.node = subtree;
            if (distance <= walk.reach) return true;
        }
        return false;
    }

    // Takes those entries of a leaf that are among the K nearest so far.
    [[gnu::always_inline]] inline void scan(const Points& points, const float* point, uint32_t skipped,
                                            const Node& node, Walk& walk, Neighbourhoods& found) const {
        Lanes<float> distance = {};
        for (size_t d = 0; d < dim; ++d)
#pragma GCC unroll 1  // vectors of lanes, not of dimensions
            for (size_t i = 0; i < lanes; ++i) {
                const float gap = coordinates[node.child * dim + d][i] - point[d];
                distance[i] += gap * gap;
            }
        Neighbour* best = &found.rows[walk.query * found.K];
        size_t& count = found.counts[walk.query];
        for (size_t i = 0; i < node.count; ++i) {
            const Neighbour next = {distance[i], entries[node.child][i]};
            if (!(next.distance <= walk.reach) || next.entry == skipped) continue;
            if (count < found.K ? next.distance == walk.reach : !points.closer(next, best[count - 1])) continue;
            size_t k = count < found.K ? count++ : count - 1;
            for (; k > 0 && points.closer(next, best[k - 1]); --k) best[k] = best[k - 1];
            best[k] = next;
            if (count == found.K) walk.reach = best[count - 1].distance;
        }
    }
};

// ---------------------------------------------------------------------------------------------------------------------
// Episodic memory: the table Q of entries (s, a^e, e).

enum class Eviction { lfu, lru };  // least frequently accessed (the paper's words), least recently (what it cites does)

struct MemoryConfig {
    int state_dim, action_dim;
    int projected_dim;          // F1; 0: no projection, states are compared as they are
    size_t capacity;            // entries
    int K;                      // neighbours
    double epsilon;             // bound on the squared distance
    double tau = 1.0;           // temperature of eq. (6); the paper has none, which is 1
    bool exclude_self = false;  // the entry of the query state itself is no neighbour
    Eviction eviction = Eviction::lfu;
};

// "Exact state matching": two states are one when their float32 bits agree, -0 taken as +0. The key is 128 bits, each
// group of four numbers folded in by a permutation: h = philox(h xor group). Up to 4 dimensions nothing can collide;
// beyond, n states share a key by chance with probability n^2 / 2^129: 2e-26 for 4e6. (No defence against an enemy.)
inline Words4 state_key(const float* state, size_t state_dim) {
    Words4 h = {};
    for (size_t i = 0; i < state_dim; i += 4) {
        for (size_t j = i; j < std::min(i + 4, state_dim); ++j)
            h[j - i] ^= std::bit_cast<uint32_t>(state[j] + 0.0f);  // -0 + 0 = +0; nothing else changes
        h = philox(h, static_cast<uint32_t>(state_dim), 0x574F4454);
    }
    return h;
}

struct EpisodicMemory {
    struct Changes {
        uint64_t inserted = 0, improved = 0, kept = 0, evicted = 0;  // entries; the first three sum to T
    };
    struct HeapItem {
        uint64_t priority, age;
        uint32_t entry;
    };

    MemoryConfig config;
    size_t S, A;                     // state_dim, action_dim
    size_t dim;                      // of the space that is searched: projected_dim, or state_dim without projection
    std::vector<double> projection;  // [projected_dim, state_dim], entries N(0, 1 / projected_dim)

    // The table, one column per field; n = size() entries.
    std::vector<uint32_t> keys;      // [n, 4]
    std::vector<float> projected;    // [n, dim]
    std::vector<float> actions;      // [n, action_dim] a^e
    std::vector<double> e;           // [n] highest discounted return ever obtained from this state
    std::vector<uint64_t> priority;  // [n] lfu: number of accesses; lru: time of the last one. Only ever grows
    std::vector<uint64_t> age;       // [n] insertion number
    uint64_t accesses = 0, insertions = 0;

    // Derived: never saved, rebuilt by rebuild_derived().
    std::vector<uint32_t> slots;  // hash table of entries: open addressing, linear probing, a power of two long
    std::vector<HeapItem> heap;   // empty until the first eviction, then one item per entry
    KdTree tree;                  // over `projected`

    EpisodicMemory(const MemoryConfig& settings, uint32_t seed)
        : config(settings),
          S(static_cast<size_t>(config.state_dim)),
          A(static_cast<size_t>(config.action_dim)),
          dim(config.projected_dim > 0 ? static_cast<size_t>(config.projected_dim) : S) {
        if (config.state_dim < 1 || config.action_dim < 1 || config.projected_dim < 0 || config.K < 1 ||
            config.capacity < 1 || config.capacity > 0x7FFFFFFF || !(config.epsilon >= 0.0) || !(config.tau > 0.0))
            fail("memory.config",
                 "episodic memory needs state_dim, action_dim, K, capacity >= 1, projected_dim, epsilon >= 0, tau > 0; "
                 "got %d, %d, %d, %zu, %d, %g, %g",
                 config.state_dim, config.action_dim, config.K, config.capacity, config.projected_dim, config.epsilon,
                 config.tau);
        // WODTEM sec. IV-B.1, projection: random, from R^F to R^F1. Variance 1 / F1 keeps the expected squared
        // distance, so that epsilon means the same before and after.
        const Random random{seed, Stream::projection};
        const double scale = 1.0 / std::sqrt(static_cast<double>(dim));
        projection.resize(static_cast<size_t>(config.projected_dim) * S);
        for (size_t i = 0; i < projection.size(); ++i)
            projection[i] = scale * random.normal(0, static_cast<uint32_t>(i));
        rebuild_derived();
    }

    size_t size() const { return e.size(); }

    // ---- eq. (4): the table

    // Every state of a relabelled trajectory, in the order of time.
    Changes update(const Trajectory& trajectory) {
        const size_t T = trajectory.rewards.size();
        check_size("states", trajectory.states.size(), T, S);
        check_size("actions", trajectory.actions.size(), T, A);
        check_size("discounted returns", trajectory.discounted_returns.size(), T, 1);
        check_finite("states", trajectory.states.data(), T * S);
        check_finite("actions", trajectory.actions.data(), T * A);
        check_finite("discounted returns", trajectory.discounted_returns.data(), T);
        Changes changes;
        std::vector<Words4> key(T);
        for (size_t t = 0; t < T; ++t) {
            key[t] = state_key(&trajectory.states[t * S], S);
            __builtin_prefetch(&slots[key[t][0] & (slots.size() - 1)]);  // find_slot() looks there first
        }
        std::vector<float> point(dim);
        for (size_t t = 0; t < T; ++t) {
            project(&trajectory.states[t * S], point.data());
            update_one(changes, key[t], point.data(), &trajectory.actions[t * A], trajectory.discounted_returns[t]);
        }
        return changes;
    }

    // WODTEM eq. (4): Q(s) <- Q(s) if stored and e >= d; (s, a, d) if stored and e < d; (s, a, d) if not stored.
    // key: state_key of s; point: s projected.
    void update_one(Changes& changes, const Words4& key, const float* point, const float* action, double d) {
        const uint32_t entry = slots[find_slot(key)];
        if (entry == no_entry) {
            ++changes.inserted;
            changes.evicted += size() == config.capacity;
            return insert(key, point, action, d);
        }
        count_access(entry);
        if (e[entry] < d) {
            ++changes.improved;
            e[entry] = d;
            set_row(actions, entry, action, A);
        } else {  // equal returns keep the older action
            ++changes.kept;
        }
    }

    void insert(const Words4& key, const float* point, const float* action, double d) {
        const bool full = size() == config.capacity;
        const uint32_t entry = full ? evict() : append();
        set_row(keys, entry, key.data(), 4);
        set_row(projected, entry, point, dim);
        set_row(actions, entry, action, A);
        e[entry] = d;
        age[entry] = insertions++;
        priority[entry] = 0;
        count_access(entry);
        slots[find_slot(key)] = entry;
        tree.insert(points(), entry);
        if (full) {
            heap.push_back({priority[entry], age[entry], entry});
            std::push_heap(heap.begin(), heap.end(), later);
        }
    }

    Points points() const { return {projected.data(), age.data()}; }

    template <class Number>
    static void set_row(std::vector<Number>& column, size_t entry, const Number* row, size_t width) {
        std::copy_n(row, width, column.begin() + static_cast<std::ptrdiff_t>(entry * width));
    }

    // One more row in every column. Room doubles, but never beyond the table's capacity.
    uint32_t append() {
        const size_t n = size(), room = std::min(config.capacity, std::max<size_t>(16, 2 * n));
        const bool grow = n == e.capacity();
        for_each_column(*this, [&](const char*, auto& column, size_t width) {
            if (grow) column.reserve(room * width);
            column.resize((n + 1) * width);
        });
        return static_cast<uint32_t>(n);
    }

    // An access: an insertion, an exact hit in update(), a neighbour that passed epsilon in a look-up.
    void count_access(uint32_t entry) {
        ++accesses;
        priority[entry] = config.eviction == Eviction::lfu ? priority[entry] + 1 : accesses;
    }

    static bool later(const HeapItem& a, const HeapItem& b) {
        return a.priority > b.priority || (a.priority == b.priority && a.age > b.age);
    }

    // WODTEM sec. IV-B.1, full table: "When Q is filled, we remove the least frequently accessed entry"; ties: the
    // oldest.
    // Accesses do not touch the heap: an item holds the priority its entry had when it was pushed, which is at most
    // what it has now. So when the smallest item proves up to date, no entry can be below it; when it does not, it goes
    // back with its present priority. Each access makes at most one item stale: amortised, one push per access.
    uint32_t evict() {
        if (heap.empty()) {
            heap.reserve(size());
            for (uint32_t i = 0; i < size(); ++i) heap.push_back({priority[i], age[i], i});
            std::make_heap(heap.begin(), heap.end(), later);
        }
        while (heap.front().priority != priority[heap.front().entry]) {
            std::pop_heap(heap.begin(), heap.end(), later);
            heap.back().priority = priority[heap.back().entry];
            std::push_heap(heap.begin(), heap.end(), later);
        }
        std::pop_heap(heap.begin(), heap.end(), later);
        const uint32_t entry = heap.back().entry;
        heap.pop_back();
        empty_slot(find_slot(key_of(entry)));
        tree.remove(points(), entry);
        return entry;
    }

    // ---- hash table

    Words4 key_of(size_t entry) const {
        return {keys[4 * entry], keys[4 * entry + 1], keys[4 * entry + 2], keys[4 * entry + 3]};
    }

    // The slot of the entry with this key, or the empty one where it would go. Keys are uniform: low bits will do.
    size_t find_slot(const Words4& key) const {
        size_t slot = key[0] & (slots.size() - 1);
        while (slots[slot] != no_entry && key_of(slots[slot]) != key) slot = (slot + 1) & (slots.size() - 1);
        return slot;
    }

    // Removal without tombstones: each later entry of the run that may move into the hole does, and leaves a new hole.
    void empty_slot(size_t hole) {
        const size_t mask = slots.size() - 1;
        for (size_t slot = (hole + 1) & mask; slots[slot] != no_entry; slot = (slot + 1) & mask) {
            const size_t home = keys[4 * size_t{slots[slot]}] & mask;
            if (((slot - home) & mask) < ((slot - hole) & mask)) continue;  // its home lies behind the hole
            slots[hole] = slots[slot];
            hole = slot;
        }
        slots[hole] = no_entry;
    }

    // ---- sec. IV-B.2: neighbours

    // [state_dim] -> [dim]. Accumulated in double, rounded once. Without projection: the state itself.
    void project(const float* state, float* point) const {
        check_finite("state", state, S);
        constexpr double largest = std::numeric_limits<float>::max();
        if (projection.empty()) std::copy_n(state, S, point);
        for (size_t row = 0; row * S < projection.size(); ++row) {
            double sum = 0.0;
            for (size_t i = 0; i < S; ++i) sum += projection[row * S + i] * state[i];
            point[row] = static_cast<float>(std::clamp(sum, -largest, largest));  // finite whatever the state
        }
        for (size_t d = 0; d < dim; ++d) point[d] += 0.0f;  // -0 becomes +0
    }

    // WODTEM sec. IV-B.2, K(s_q): {(s_k, a_k^e, e_k) : q(s_q, s_k) < epsilon, 1 <= k <= K}, closest first, for a
    // projected s_q; `skipped` is passed over. Specification:
    std::vector<Neighbour> nearest_plain(const float* point, uint32_t skipped) const {
        std::vector<Neighbour> found;
        for (uint32_t i = 0; i < size(); ++i) {
            const float distance = squared_distance(&projected[i * dim], point, dim);
            if (i != skipped && distance < config.epsilon) found.push_back({distance, i});
        }
        std::sort(found.begin(), found.end(), [&](auto& a, auto& b) { return points().closer(a, b); });
        found.resize(std::min(found.size(), static_cast<size_t>(config.K)));
        return found;
    }

    // The same from the tree, for many projected states `at` [n, dim] and the entries skipped [n] at once.
    Neighbourhoods nearest(const std::vector<float>& at, const std::vector<uint32_t>& skipped) const {
        Neighbourhoods found{static_cast<size_t>(config.K), {}, {}};
        found.rows.resize(skipped.size() * found.K);
        found.counts.resize(skipped.size());
        // The smallest float that is not below epsilon: the same floats are below both.
        float limit = static_cast<float>(std::min<double>(config.epsilon, std::numeric_limits<float>::max()));
        if (limit < config.epsilon) limit = std::nextafter(limit, INFINITY);
        tree.search(points(), at.data(), skipped.data(), limit, found);
        return found;
    }

    // K(s_q) of n states [n, state_dim]. Changes nothing, so many threads may search at once; then count_accesses() on
    // each result in a fixed order, before the next update() (which may give an entry number to another state).
    Neighbourhoods search(const float* states, size_t n) const {
        std::vector<float> at(n * dim);
        std::vector<uint32_t> skipped(n, no_entry);
        for (size_t i = 0; i < n; ++i) {
            project(states + i * S, &at[i * dim]);
            if (config.exclude_self) skipped[i] = slots[find_slot(state_key(states + i * S, S))];
        }
        return nearest(at, skipped);
    }

    void count_accesses(std::span<const Neighbour> found) {
        for (const Neighbour& neighbour : found) count_access(neighbour.entry);
    }

    // ---- eqs. (5) to (7). `found` is K(s_q).

    // exp(-q_k) / exp(-q_1), where q_1 is the smallest distance: the quotient in eq. (5) is the same, and no distance can
    // make it 0 / 0. The float exp is used, because the bits of libm's double exp depend on the processor.
    static double similarity(std::span<const Neighbour> found, size_t k) {
        return std::exp(found[0].distance - found[k].distance);
    }

    // e-hat(s_q) of eq. (5) as it is written, for the golden vectors and the tests; training compares by is_optimal().
    // Returns NaN, that is unknown, for an empty K(s_q).
    double approximate_return(std::span<const Neighbour> found) const {
        double sum = 0.0, normaliser = 0.0;
        for (size_t k = 0; k < found.size(); ++k) {
            sum += similarity(found, k) * e[found[k].entry];
            normaliser += similarity(found, k);
        }
        return sum / normaliser;
    }

    // WODTEM eq. (5): e-hat(s_q) = sum_k p_k e_k, p_k = exp(-q(s_q, s_k)) / sum_k1 exp(-q(s_q, s_k1)).
    // Returns whether d >= e-hat(s_q), that is whether a_c is "the historical optimal action". The p_k sum to 1, so the
    // comparison is sum_k exp(-q_k) (e_k - d) <= 0. This form is exact where it matters: if all e_k equal d, each term is
    // 0, whereas a rounded mean of equal numbers can exceed them and would give such a pair the weight alpha. Without
    // neighbours the sum is empty and the answer yes: nothing speaks against a_c.
    bool is_optimal(std::span<const Neighbour> found, double d) const {
        double excess = 0.0;
        for (size_t k = 0; k < found.size(); ++k) excess += similarity(found, k) * (e[found[k].entry] - d);
        return excess <= 0.0;
    }

    // WODTEM eq. (7): w(s, a) = 1 if d >= e-hat(s), else alpha. `optimal` is what is_optimal() returned.
    static double weight(bool optimal, double alpha) { return optimal ? 1.0 : alpha; }

    // WODTEM eq. (6): p(a_k^e | s_q, s_k, e_k) = exp(e_k / tau) / sum_k1 exp(e_k1 / tau); a-hat(s_q) is drawn from it.
    // The largest e is subtracted first: e reaches thousands and exp(89) overflows a float. `uniform` lies in [0, 1); the
    // neighbour is drawn by the inverse of the cumulative distribution. Returns the action [action_dim].
    const float* advised_action(std::span<const Neighbour> found, double uniform) const {
        if (found.empty()) fail("memory.no_neighbours", "no neighbour within epsilon: there is no action to advise");
        double best = e[found[0].entry], total = 0.0, cumulative = 0.0;
        for (const Neighbour& neighbour : found) best = std::max(best, e[neighbour.entry]);
        const auto odds = [&](const Neighbour& neighbour) {
            return double{std::exp(static_cast<float>((e[neighbour.entry] - best) / config.tau))};
        };
        for (const Neighbour& neighbour : found) total += odds(neighbour);
        // uniform <= 1 - 2^-53 makes uniform * total < total even when rounded, and the cumulative sum ends in total. So
        // one neighbour is drawn, and never one of probability 0, which leaves the sum unchanged.
        size_t k = 0;
        for (; k + 1 < found.size(); ++k) {
            cumulative += odds(found[k]);
            if (cumulative > uniform * total) break;
        }
        return &actions[found[k].entry * A];
    }

    // ---- saving and loading

    // each(name, column, numbers per entry)
    template <class Self, class Each>
    static void for_each_column(Self& self, const Each& each) {
        each("memory.keys", self.keys, size_t{4});
        each("memory.projected", self.projected, self.dim);
        each("memory.actions", self.actions, self.A);
        each("memory.e", self.e, size_t{1});
        each("memory.priority", self.priority, size_t{1});
        each("memory.age", self.age, size_t{1});
    }

    template <class Archive>
    void visit(Archive& archive) {
        for_each_column(*this, [&](const char* name, auto& column, size_t) { archive(name, column); });
        archive("memory.projection", projection);
        archive("memory.accesses", accesses);
        archive("memory.insertions", insertions);
        if (archive.loading) rebuild_derived();
    }

    // Everything that is not saved, from what is; refuses what no run can have saved.
    void rebuild_derived() {
        const auto require = [](bool holds, const char* name, const char* what) {
            if (!holds) fail("checkpoint.memory", "the episodic memory does not fit together: %s %s", name, what);
        };
        const size_t n = size();
        require(n <= config.capacity, "memory.e", "has more entries than the table may hold");
        for_each_column(*this, [&](const char* name, const auto& column, size_t width) {
            require(column.size() == n * width, name, "has a wrong number of values");
            for (const auto value : column)
                require(std::isfinite(static_cast<double>(value)), name, "holds a number that is not finite");
        });
        const size_t cells = static_cast<size_t>(config.projected_dim) * S;
        require(projection.size() == cells, "memory.projection", "has a wrong number of values");
        for (const double value : projection) require(std::isfinite(value), "memory.projection", "is not finite");
        std::vector<uint64_t> ages = age;
        std::sort(ages.begin(), ages.end());
        require(std::adjacent_find(ages.begin(), ages.end()) == ages.end(), "memory.age", "repeats itself");
        require(n == 0 || ages.back() < insertions, "memory.age", "exceeds memory.insertions");
        for (const uint64_t value : priority)
            require(value >= 1 && value <= accesses, "memory.priority", "lies outside 1 .. memory.accesses");
        slots.assign(std::bit_ceil(config.capacity + config.capacity / 2 + 1), no_entry);  // load at most 2/3
        for (uint32_t i = 0; i < n; ++i) {
            uint32_t& slot = slots[find_slot(key_of(i))];
            require(slot == no_entry, "memory.keys", "holds a key twice");
            slot = i;
        }
        heap.clear();
        tree.build(points(), dim, static_cast<uint32_t>(n));
    }
};
