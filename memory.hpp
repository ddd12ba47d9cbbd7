// memory.hpp: what the agent remembers: trajectories and their returns, the replay buffer D, the episodic memory Q.
//   sec. III-A      g_t and d_t                     returns_to_go, discounted_returns, relabel
//   sec. III-A      D_offline, D_online             offline_set, ReplayBuffer
//   sec. IV-B.1     the table Q, eq. (4)            EpisodicMemory::update    (the paper's rule between (3) and (5))
//   sec. IV-B.2     K(s_q), eqs. (5) and (6)        search, neighbours, approximate_return, remembered_action
//   sec. IV-B.3     eq. (7)                         weight
// Promises: exact nearest neighbours; every tie has a stated winner, so results depend on the order of updates and
// look-ups and on nothing else (not on when the search tree was built, not on a save and load in between); a refused
// trajectory leaves the table as it was. Leaves out: networks, environments, files, threads (search() is safe in many).
//
// Memory per entry, with projected_dim 4, action_dim 8 and a full table of 2e6: 88 bytes saved (key 16, projected state
// 16, action 32, e 8, priority 8, age 8) and 58 derived (hash slots 8.4, search tree 25, eviction heap 24): 291 MB.
// Building the tree takes 8 more per entry for a moment. The raw state is not kept: its key and projection are.
// At that size, on one 2.5 GHz Xeon core: a look-up (K = 2) takes 4 microseconds, building the tree 1.1 seconds.
#pragma once

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

#include "nn.hpp"

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

// WODTEM sec. III-A: d_t = sum_{t'=t..T} gamma^(t'-t) r_t', backwards as d_t = r_t + gamma d_{t+1}, d_{T+1} = 0.
// A plain sum to the last step, also when the time limit cut the trajectory: nothing is bootstrapped.
inline std::vector<double> discounted_returns(const std::vector<float>& rewards, double gamma) {
    std::vector<double> d(rewards.size());
    double next = 0.0;
    for (size_t t = rewards.size(); t-- > 0;) d[t] = next = rewards[t] + gamma * next;
    return d;
}

// WODTEM sec. III-A: g_t = sum_{t'=t..T} r_t', which is d_t with gamma = 1.
// departs from ODT's code: summed in double, not in float32.
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

    // WODTEM sec. III-A: first in, first out: append until full, then overwrite from index 0 upwards, lap after lap.
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

    // A trajectory with probability proportional to its length, a start uniform over its steps, then the next
    // min(context_length, what is left) steps: windows near the end are short. One draw over all steps laid end to end
    // gives both exactly: a trajectory owns `length` of the `total` numbers, each of them one start.
    Window sample(const Random& random, uint64_t update, uint32_t window_index, int context_length) const {
        if (trajectories.empty()) fail("replay.empty", "cannot sample: the replay buffer holds no trajectory");
        const uint64_t step = random.below(ends.back(), update, window_index);
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
    uint64_t age;  // insertion number: smaller is older
};

// The order of neighbours. Ties: smaller distance, then older entry; ages differ, so this is a total order.
inline bool closer(const Neighbour& a, const Neighbour& b) {
    return a.distance < b.distance || (a.distance == b.distance && a.age < b.age);
}

// The K closest of all neighbours offered so far.
struct Closest {
    size_t K;
    std::vector<Neighbour> list = {};                                             // closest first
    Neighbour worst = {std::numeric_limits<float>::infinity(), no_entry, ~0ull};  // to be beaten

    void offer(const Neighbour& candidate) {
        if (!closer(candidate, worst)) return;
        if (list.size() == K) list.pop_back();
        list.insert(std::upper_bound(list.begin(), list.end(), candidate, closer), candidate);
        if (list.size() == K) worst = list.back();
    }
};

inline float squared_distance(const float* a, const float* b, size_t dim) {
    float sum = 0.0f;
    for (size_t d = 0; d < dim; ++d) sum += (a[d] - b[d]) * (a[d] - b[d]);
    return sum;
}

// A k-d tree with bounding boxes. Points are cut at the middle INDEX of the widest dimension, rounded to whole leaves,
// so that any number of equal points gives the same balanced shape: every leaf but the last is full. Inner nodes over m
// leaves form a block of m - 1: the node, those of its left half, those of its right half; no child needs a pointer.
// Box 2 j + c is that of child c of inner node j (both in one cache line when dim = 4); the last one is the root's.
struct BoxTree {
    static constexpr size_t leaf_size = 16;
    size_t dim = 0, count = 0;      // points
    uint64_t built_at = 0;          // insertions into the table before this tree was built
    std::vector<float> leaves;      // [leaf, dim, leaf_size]: copies, side by side, so that a leaf is scanned in lanes
    std::vector<uint32_t> entries;  // [count] in the order of the leaves
    std::vector<float> boxes;       // [box, 2, dim]: lowest, highest coordinate
    std::vector<uint64_t> oldest;   // [box] smallest age inside

    using Order = std::vector<std::pair<float, uint32_t>>;  // (coordinate to cut by, entry)

    size_t leaf_count() const { return (count + leaf_size - 1) / leaf_size; }

    void build(const std::vector<float>& points, const std::vector<uint64_t>& ages, size_t point_dim, uint64_t now) {
        dim = point_dim;
        count = ages.size();
        built_at = now;
        const size_t m = leaf_count();
        leaves.assign(m * dim * leaf_size, 0.0f);
        entries.assign(count, no_entry);
        boxes.assign(m * 4 * dim, 0.0f);
        oldest.assign(m * 2, 0);
        Order order(count);
        for (size_t i = 0; i < count; ++i) order[i].second = static_cast<uint32_t>(i);
        if (count > 0) build_node(order, points.data(), ages, 0, 2 * m - 2, 0, m);
    }

    // Leaves [first, last): inner node `node`, if more than one, with its own box at `box`.
    void build_node(Order& order, const float* points, const std::vector<uint64_t>& ages, size_t node, size_t box,
                    size_t first, size_t last) {
        const auto begin = order.begin() + static_cast<std::ptrdiff_t>(first * leaf_size);
        const auto end = order.begin() + static_cast<std::ptrdiff_t>(std::min(last * leaf_size, count));
        float *low = &boxes[box * 2 * dim], *high = low + dim;
        std::copy_n(points + begin->second * dim, dim, low);
        std::copy_n(points + begin->second * dim, dim, high);
        oldest[box] = ages[begin->second];
        for (auto point = begin; point != end; ++point) {
            for (size_t d = 0; d < dim; ++d) {
                low[d] = std::min(low[d], points[point->second * dim + d]);
                high[d] = std::max(high[d], points[point->second * dim + d]);
            }
            oldest[box] = std::min(oldest[box], ages[point->second]);
        }
        if (last - first == 1) return copy_leaf(order, points, first);
        size_t widest = 0;
        for (size_t d = 1; d < dim; ++d)
            if (high[d] - low[d] > high[widest] - low[widest]) widest = d;
        for (auto point = begin; point != end; ++point) point->first = points[point->second * dim + widest];
        const size_t middle = (first + last) / 2;
        std::nth_element(begin, order.begin() + static_cast<std::ptrdiff_t>(middle * leaf_size), end);
        build_node(order, points, ages, node + 1, 2 * node, first, middle);
        build_node(order, points, ages, node + middle - first, 2 * node + 1, middle, last);
    }

    void copy_leaf(const Order& order, const float* points, size_t leaf) {
        for (size_t i = leaf * leaf_size; i < std::min((leaf + 1) * leaf_size, count); ++i) {
            entries[i] = order[i].second;
            for (size_t d = 0; d < dim; ++d)
                leaves[(leaf * dim + d) * leaf_size + i % leaf_size] = points[entries[i] * dim + d];
        }
    }

    // Squared distance from the query to the nearest point c of a box, never above the computed distance of any point x
    // inside: |query - c| <= |query - x| in each coordinate, and rounding, being monotone and odd, keeps this <=, as do
    // squaring and adding in the same order with the rounding after each.
    float bound(const float* query, size_t box) const {
        const float *low = &boxes[box * 2 * dim], *high = low + dim;
        float sum = 0.0f;
        for (size_t d = 0; d < dim; ++d) {
            const float gap = query[d] - std::min(std::max(query[d], low[d]), high[d]);
            sum += gap * gap;
        }
        return sum;
    }

    // offer(entry, distance) meets every point that could be closer than best.worst, nearer half first. A box whose
    // bound equals the worst distance can still hold an older entry at just that distance.
    template <class Offer>
    void search(const Closest& best, const float* query, const Offer& offer, size_t node, size_t first,
                size_t last) const {
        if (last - first == 1) return scan_leaf(best, query, offer, first);
        const size_t middle = (first + last) / 2;
        const float bounds[2] = {bound(query, 2 * node), bound(query, 2 * node + 1)};
        const size_t nearer = bounds[1] < bounds[0];
        for (const size_t child : {nearer, 1 - nearer}) {
            if (bounds[child] > best.worst.distance) continue;
            if (bounds[child] == best.worst.distance && oldest[2 * node + child] > best.worst.age) continue;
            if (child == 0) search(best, query, offer, node + 1, first, middle);
            if (child == 1) search(best, query, offer, node + middle - first, middle, last);
        }
    }

    template <class Offer>
    void scan_leaf(const Closest& best, const float* query, const Offer& offer, size_t leaf) const {
        const float* block = &leaves[leaf * dim * leaf_size];
        float distance[leaf_size] = {};
        for (size_t d = 0; d < dim; ++d, block += leaf_size)
            for (size_t i = 0; i < leaf_size; ++i) distance[i] += (block[i] - query[d]) * (block[i] - query[d]);
        const size_t first = leaf * leaf_size;
        for (size_t i = 0; i < std::min(leaf_size, count - first); ++i)
            if (distance[i] <= best.worst.distance) offer(entries[first + i], distance[i]);
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
    std::vector<uint32_t> slots;   // hash table of entries: open addressing, linear probing, a power of two long
    std::vector<HeapItem> heap;    // empty until the first eviction, then one item per entry
    BoxTree tree;                  // over the entries with age < tree.built_at
    std::vector<uint32_t> recent;  // the others, scanned one by one
    static constexpr size_t recent_limit = 512;

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
        // WODTEM sec. IV-B.1: random projection from R^F to R^F1. Variance 1 / F1 keeps the expected squared distance,
        // so that epsilon means the same before and after.
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
        for (size_t t = 0; t < T; ++t)
            update_one(changes, &trajectory.states[t * S], &trajectory.actions[t * A],
                       trajectory.discounted_returns[t]);
        return changes;
    }

    // WODTEM eq. (4): Q(s) <- Q(s) if stored and e >= d; (s, a, d) if stored and e < d; (s, a, d) if not stored.
    void update_one(Changes& changes, const float* state, const float* action, double d) {
        const Words4 key = state_key(state, S);
        const uint32_t entry = slots[find_slot(key)];
        if (entry == no_entry) {
            ++changes.inserted;
            changes.evicted += size() == config.capacity;
            return insert(key, project(state), action, d);
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

    void insert(const Words4& key, const std::vector<float>& point, const float* action, double d) {
        const bool full = size() == config.capacity;
        const uint32_t entry = full ? evict() : append();
        if (!full || age[entry] < tree.built_at) recent.push_back(entry);  // else it is there already
        set_row(keys, entry, key.data(), 4);
        set_row(projected, entry, point.data(), dim);
        set_row(actions, entry, action, A);
        e[entry] = d;
        age[entry] = insertions++;
        priority[entry] = 0;
        count_access(entry);
        slots[find_slot(key)] = entry;
        if (full) {
            heap.push_back({priority[entry], age[entry], entry});
            std::push_heap(heap.begin(), heap.end(), later);
        }
    }

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

    // WODTEM sec. IV-B.1: "When Q is filled, we remove the least frequently accessed entry"; ties: the oldest.
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
    std::vector<float> project(const float* state) const {
        check_finite("state", state, S);
        constexpr double largest = std::numeric_limits<float>::max();
        std::vector<float> point(state, state + (projection.empty() ? S : 0));
        for (size_t row = 0; row < projection.size(); row += S) {
            double sum = 0.0;
            for (size_t i = 0; i < S; ++i) sum += projection[row + i] * state[i];
            point.push_back(static_cast<float>(std::clamp(sum, -largest, largest)));  // finite whatever the state
        }
        for (float& coordinate : point) coordinate += 0.0f;  // -0 becomes +0
        return point;
    }

    // The K nearest entries to a point, closest first; `skipped` is passed over. Specification:
    std::vector<Neighbour> nearest_plain(const float* point, uint32_t skipped = no_entry) const {
        Closest best{static_cast<size_t>(config.K)};
        for (uint32_t i = 0; i < size(); ++i)
            if (i != skipped) best.offer({squared_distance(&projected[i * dim], point, dim), i, age[i]});
        return best.list;
    }

    // The same from the tree and the recent entries. A slot reused since the tree was built is younger than the tree:
    // its old point is passed over there, its new one is among the recent. So a stale tree is slower, never wrong.
    std::vector<Neighbour> nearest(const float* point, uint32_t skipped = no_entry) const {
        Closest best{static_cast<size_t>(config.K)};
        for (const uint32_t i : recent)
            if (i != skipped) best.offer({squared_distance(&projected[i * dim], point, dim), i, age[i]});
        const auto offer = [&](uint32_t i, float distance) {
            if (i != skipped && age[i] < tree.built_at) best.offer({distance, i, age[i]});
        };
        if (tree.count > 0) tree.search(best, point, offer, 0, 0, tree.leaf_count());
        return best.list;
    }

    // WODTEM sec. IV-B.2: K(s_q) = {(s_k, a_k^e, e_k) : q(s_q, s_k) < epsilon, 1 <= k <= K}, closest first.
    // Changes nothing, so many threads may search at once; then count_accesses() on each result in a fixed order,
    // before the next update() (which may give an entry number to another state).
    std::vector<Neighbour> search(const float* state) const {
        const std::vector<float> point = project(state);
        const auto own = [&] { return slots[find_slot(state_key(state, S))]; };
        std::vector<Neighbour> found = nearest(point.data(), config.exclude_self ? own() : no_entry);
        while (!found.empty() && !(found.back().distance < config.epsilon)) found.pop_back();
        return found;
    }

    void count_accesses(const std::vector<Neighbour>& found) {
        for (const Neighbour& neighbour : found) count_access(neighbour.entry);
    }

    // search(), counted, from a fresh enough tree.
    std::vector<Neighbour> neighbours(const float* state) {
        refresh_index();
        const std::vector<Neighbour> found = search(state);
        count_accesses(found);
        return found;
    }

    // Rebuilds the tree when too many entries are not in it: more than an eighth of it, or recent_limit (about a
    // microsecond to scan). Who calls search() directly calls this after updates.
    void refresh_index() {
        if (recent.size() > std::min(recent_limit, tree.count / 8)) rebuild_index();
    }

    void rebuild_index() {
        if (recent.empty()) return;
        tree.build(projected, age, dim, insertions);
        recent = {};
    }

    // ---- eqs. (5) to (7). `found` is K(s_q).

    // exp(-q_k) over exp(-q_1), the largest: the quotient in (5) is the same and no epsilon can make it 0 / 0. The float
    // exp: libm's in double gives other bits on other processors. Sums are in double.
    static double similarity(const std::vector<Neighbour>& found, size_t k) {
        return std::exp(found[0].distance - found[k].distance);
    }

    // WODTEM eq. (5): e-hat(s_q) = sum_k p_k e_k, p_k = exp(-q(s_q, s_k)) / sum_k1 exp(-q(s_q, s_k1)).
    // NaN, that is unknown, for an empty K(s_q).
    double approximate_return(const std::vector<Neighbour>& found) const {
        double sum = 0.0, normaliser = 0.0;
        for (size_t k = 0; k < found.size(); ++k) {
            sum += similarity(found, k) * e[found[k].entry];
            normaliser += similarity(found, k);
        }
        return sum / normaliser;
    }

    // WODTEM eq. (6): p(a_k^e | s_q, s_k, e_k) = exp(e_k / tau) / sum_k1 exp(e_k1 / tau); a-hat(s_q) is drawn from it.
    // e reaches thousands, exp(89) overflows float: the largest e is subtracted first. Returns action_dim numbers.
    const float* remembered_action(const std::vector<Neighbour>& found, double uniform) const {
        if (found.empty()) fail("memory.no_neighbours", "no neighbour within epsilon: there is no action to remember");
        double best = e[found[0].entry], total = 0.0, cumulative = 0.0;
        for (const Neighbour& neighbour : found) best = std::max(best, e[neighbour.entry]);
        const auto odds = [&](const Neighbour& neighbour) {
            return double{std::exp(static_cast<float>((e[neighbour.entry] - best) / config.tau))};
        };
        for (const Neighbour& neighbour : found) total += odds(neighbour);
        // uniform <= 1 - 2^-53 makes uniform * total < total also when rounded, and the sums below end in total: one of
        // the neighbours is chosen, and never one of probability 0, which leaves the sum where it was.
        size_t k = 0;
        while (k + 1 < found.size() && (cumulative += odds(found[k])) <= uniform * total) ++k;
        return &actions[found[k].entry * A];
    }

    // Is a_c "the historical optimal action": d >= e-hat(s)? Tested as sum_k p_k (e_k - d) <= 0, which is exact where
    // it matters: a rounded mean of equal numbers can exceed them, and give alpha for nothing. No neighbours: yes,
    // nothing speaks against it.
    bool is_optimal(const std::vector<Neighbour>& found, double d) const {
        double excess = 0.0;
        for (size_t k = 0; k < found.size(); ++k) excess += similarity(found, k) * (e[found[k].entry] - d);
        return excess <= 0.0;
    }

    // WODTEM eq. (7): w(s, a) = 1 if d >= e-hat(s), else alpha.
    double weight(const std::vector<Neighbour>& found, double d, double alpha) const {
        return is_optimal(found, d) ? 1.0 : alpha;
    }

    // ---- saving, loading, size

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
        tree = {};
        recent.resize(n);
        for (uint32_t i = 0; i < n; ++i) recent[i] = i;
    }

    // Bytes of memory in use, derived state included.
    size_t bytes() const {
        size_t total = 0;
        const auto add = [&](const auto& column) { total += column.capacity() * sizeof(column[0]); };
        for_each_column(*this, [&](const char*, const auto& column, size_t) { add(column); });
        add(projection), add(slots), add(heap), add(recent);
        add(tree.leaves), add(tree.entries), add(tree.boxes), add(tree.oldest);
        return total;
    }
};
