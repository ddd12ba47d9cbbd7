// memory.hpp: what the agent remembers: trajectories and their returns, the replay buffer D, the episodic memory Q.
//   sec. III-A      g_t and d_t                     returns_to_go, discounted_returns, relabel
//   sec. III-A      D_offline, D_online             offline_set, ReplayBuffer
//   sec. IV-B.1     the table Q, eq. (4)            EpisodicMemory::update    (the paper's rule between (3) and (5))
//   sec. IV-B.2     K(s_q), eqs. (5) and (6)        nearest, search, approximate_return, remembered_action
//   sec. IV-B.3     eq. (7)                         weight
// Promises: exact nearest neighbours; every tie has a stated winner, so results depend on the order of updates and
// look-ups and on nothing else (not on when the search tree was built, not on a save and load in between); a refused
// trajectory leaves the table as it was. Leaves out: networks, environments, files, threads (search() is safe in many).
//
// Memory per entry, with projected_dim 4, action_dim 8 and a full table of 2e6: 88 bytes saved (key 16, projected state
// 16, action 32, e 8, priority 8, age 8) and 77 to 93 derived (hash slots 8.4, search tree 45 to 61, eviction heap 24):
// 330 to 362 MB. Building the tree takes 8 more per entry for a moment. The raw state is not kept: its key and
// projection are. At that size, on one core of an EPYC (README): a look-up (K = 2, thousands at once) takes 0.6
// microseconds, an insertion 0.8, one that evicts 2.4, building the tree 0.9 seconds.
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

    // WODTEM sec. III-B, C^t: the steps of a sub-trajectory. A trajectory with probability proportional to its length,
    // a start uniform over its steps, then the next min(context_length, what is left) steps: windows near the end are
    // short.
    // departs from the paper: as ODT's code does, not the latest C steps up to t, which are short at the beginning.
    // One draw over all steps laid end to end
    // gives both exactly: a trajectory owns `length` of the `total` numbers, each of them one start.
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

// What the tree knows of the table. An age is an insertion number: smaller is older, and no two are equal.
struct Points {
    const float* rows;  // [entry, dim]
    const uint64_t* ages;

    // The order of neighbours. Ties: smaller distance, then older entry.
    bool closer(const Neighbour& a, const Neighbour& b) const {
        return a.distance < b.distance || (a.distance == b.distance && ages[a.entry] < ages[b.entry]);
    }
};

// A search for the nearest entries to a point.
struct Query {
    const float* point;
    uint32_t skipped;  // the entry that does not count, or no_entry
    Neighbour* best;   // room for K of them; found, closest first:
    size_t found = 0;
};

// A tree of bounding boxes, 16 to a node, that grows like a B-tree: all leaves are equally deep, a full node splits in
// two. (Guttman, "R-trees", SIGMOD 1984.) In level 0 the lanes of a node hold entries; in a level above, nodes of the
// level below, each with its box and the age of its oldest entry. The lanes lie side by side: one pass of vector code
// gives 16 distances. Splits keep boxes apart, which is what makes a search short; nothing else depends on the shape.
struct BoxTree {
    static constexpr size_t lanes = 16;
    static constexpr size_t fewest = 4;        // lanes in use, but for the root; those in use come first
    static constexpr size_t comfortable = 12;  // lanes in use after building: room for more
    // Two halves of a node may overlap by this part of its extent. None at all: insertion takes two and a half times as
    // long, because more is built anew. 0.04: a look-up takes 1.3 times as long.
    static constexpr float tolerance = 0.01f;

    template <class Number>
    struct alignas(64) Lanes : std::array<Number, lanes> {};

    struct Level {
        std::vector<Lanes<float>> boxes;      // [node, dim, side] lowest, highest coordinate; in level 0 one for both
        std::vector<Lanes<uint32_t>> child;   // [node] entry, or node of the level below; no_entry: nothing
        std::vector<Lanes<uint64_t>> oldest;  // [node] not in level 0: there the table has it
        std::vector<uint32_t> home;           // [child] the node it is in
        std::vector<uint32_t> unused;         // nodes
    };

    size_t dim = 0;
    std::vector<Level> levels = {};
    uint32_t root = 0;  // in the last level

    static size_t sides(size_t level) { return level == 0 ? 1 : 2; }
    size_t top() const { return levels.size() - 1; }
    Lanes<uint32_t>& child(size_t level, size_t node) { return levels[level].child[node]; }
    Lanes<float>& low(size_t level, size_t node, size_t d) {
        return levels[level].boxes[(node * dim + d) * sides(level)];
    }
    Lanes<float>& high(size_t level, size_t node, size_t d) {
        return levels[level].boxes[(node * dim + d + 1) * sides(level) - 1];
    }
    size_t lane_of(size_t level, size_t node, uint32_t what) const {
        const Lanes<uint32_t>& list = levels[level].child[node];
        return static_cast<size_t>(std::find(list.begin(), list.end(), what) - list.begin());
    }
    // Looks at all lanes at once, and so waits for one that has just been stored.
    size_t used(size_t level, size_t node) const {
        const Lanes<uint32_t>& list = levels[level].child[node];
        return static_cast<size_t>(std::countr_one(lanes_where([&](size_t i) { return list[i] != no_entry; })));
    }

    // ---- nodes and lanes

    template <class Column>
    static void grow(Column& column, size_t size, const typename Column::value_type& value) {
        if (size > column.capacity()) column.reserve(size + size / 4);
        column.resize(size, value);
    }

    uint32_t add_node(size_t level) {
        Level& at = levels[level];
        const uint32_t node = at.unused.empty() ? static_cast<uint32_t>(at.child.size()) : at.unused.back();
        if (!at.unused.empty()) return at.unused.pop_back(), node;
        grow(at.boxes, (node + 1) * dim * sides(level), {});
        grow(at.child, node + 1, {});
        if (level > 0) grow(at.oldest, node + 1, {});
        for (size_t lane = 0; lane < lanes; ++lane) clear_lane(level, node, lane);
        return node;
    }

    // An empty lane is infinitely far from every point.
    void clear_lane(size_t level, size_t node, size_t lane) {
        child(level, node)[lane] = no_entry;
        for (size_t d = 0; d < dim; ++d) {
            high(level, node, d)[lane] = -INFINITY;
            low(level, node, d)[lane] = INFINITY;
        }
    }

    void set_child(size_t level, size_t node, size_t lane, uint32_t what) {
        child(level, node)[lane] = what;
        std::vector<uint32_t>& home = levels[level].home;
        if (what >= home.size()) grow(home, what + 1, no_entry);
        home[what] = static_cast<uint32_t>(node);
    }

    void move_lane(size_t level, size_t from, size_t from_lane, size_t to, size_t to_lane) {
        set_child(level, to, to_lane, child(level, from)[from_lane]);
        for (size_t d = 0; d < dim; ++d) {
            low(level, to, d)[to_lane] = low(level, from, d)[from_lane];
            high(level, to, d)[to_lane] = high(level, from, d)[from_lane];
        }
        if (level > 0) levels[level].oldest[to][to_lane] = levels[level].oldest[from][from_lane];
    }

    void erase_lane(size_t level, size_t node, size_t lane) {
        const size_t last = used(level, node) - 1;
        if (lane != last) move_lane(level, node, last, node, lane);
        clear_lane(level, node, last);
    }

    void put_entry(const Points& points, size_t leaf, size_t lane, uint32_t entry) {
        set_child(0, leaf, lane, entry);
        for (size_t d = 0; d < dim; ++d) low(0, leaf, d)[lane] = points.rows[entry * dim + d];
    }

    void put_node(const Points& points, size_t level, size_t node, size_t lane, uint32_t below) {
        set_child(level, node, lane, below);
        enclose(points, level, node, lane);
    }

    // Fits the box in a lane to what is below. Returns whether it did not fit.
    bool enclose(const Points& points, size_t level, size_t node, size_t lane) {
        const uint32_t below = child(level, node)[lane];
        const size_t n = used(level - 1, below);
        bool changed = false;
        const auto set = [&](auto& old, auto now) { changed |= old != now, old = now; };
        for (size_t d = 0; d < dim; ++d) {
            const Lanes<float>&lows = low(level - 1, below, d), &highs = high(level - 1, below, d);
            set(low(level, node, d)[lane], *std::min_element(lows.begin(), lows.begin() + n));
            set(high(level, node, d)[lane], *std::max_element(highs.begin(), highs.begin() + n));
        }
        uint64_t oldest = ~uint64_t{0};
        for (size_t i = 0; i < n; ++i)
            oldest = std::min(oldest, level > 1 ? levels[level - 1].oldest[below][i] : points.ages[child(0, below)[i]]);
        set(levels[level].oldest[node][lane], oldest);
        return changed;
    }

    // ---- building

    using Ranked = std::pair<float, uint32_t>;
    using Order = std::vector<Ranked>;  // (coordinate to cut by, entry)
    using Iterator = Order::iterator;

    // A tree of the table's first n entries.
    void build(const Points& points, size_t point_dim, uint32_t n) {
        dim = point_dim;
        levels.assign(1, {});
        for (size_t room = lanes; n > room; room *= comfortable) levels.emplace_back();
        Order order(n);
        for (uint32_t i = 0; i < n; ++i) order[i].second = i;
        root = build_node(points, top(), order.begin(), order.end());
    }

    uint32_t build_node(const Points& points, size_t level, Iterator begin, Iterator end) {
        const uint32_t node = add_node(level);
        if (level == 0) {
            for (auto i = begin; i != end; ++i) put_entry(points, node, static_cast<size_t>(i - begin), i->second);
            return node;
        }
        size_t room = 1;  // in a comfortable node of the level below
        for (size_t i = 0; i < level; ++i) room *= comfortable;
        const size_t n = static_cast<size_t>(end - begin);  // at most half of 16^(level + 1), or else all there is
        build_lanes(points, level, node, 0, std::clamp((n + room - 1) / room, fewest, lanes - 1), begin, end);
        return node;
    }

    // `count` lanes from `lane` on.
    void build_lanes(const Points& points, size_t level, uint32_t node, size_t lane, size_t count, Iterator begin,
                     Iterator end) {
        if (count == 1) return put_node(points, level, node, lane, build_node(points, level - 1, begin, end));
        const Iterator middle =
            begin + (end - begin) * static_cast<ptrdiff_t>(count / 2) / static_cast<ptrdiff_t>(count);
        cut(points, begin, middle, end);
        build_lanes(points, level, node, lane, count / 2, begin, middle);
        build_lanes(points, level, node, lane + count / 2, count - count / 2, middle, end);
    }

    // Entries before `middle` get the lower coordinates in the widest dimension.
    void cut(const Points& points, Iterator begin, Iterator middle, Iterator end) const {
        size_t widest = 0;
        float extent = -1.0f;
        for (size_t d = 0; d < dim; ++d) {
            float least = INFINITY, most = -INFINITY;
            for (auto i = begin; i != end; ++i) {
                least = std::min(least, points.rows[i->second * dim + d]);
                most = std::max(most, points.rows[i->second * dim + d]);
            }
            if (most - least > extent) extent = most - least, widest = d;
        }
        for (auto i = begin; i != end; ++i) i->first = points.rows[i->second * dim + widest];
        std::nth_element(begin, middle, end);
    }

    // ---- coming and going

    // Down to a leaf by the nearest boxes; what is full on the way splits before it is entered.
    void insert(const Points& points, uint32_t entry) {
        const float* point = points.rows + entry * dim;
        if (used(top(), root) == lanes) {
            levels.emplace_back();
            const uint32_t below = root;
            root = add_node(top());
            put_node(points, top(), root, 0, below);
        }
        uint32_t node = root;
        for (size_t level = top(); level > 0; --level) {
            size_t lane = nearest_lane(level, node, point, 0);
            send_for(level - 1, child(level, node)[lane]);
            if (used(level - 1, child(level, node)[lane]) == lanes) {
                const size_t halves = split(points, level, node, lane);
                lane = nearest_lane(level, node, point, halves);
            }
            for (size_t d = 0; d < dim; ++d) {
                float &least = low(level, node, d)[lane], &most = high(level, node, d)[lane];
                if (point[d] < least) least = point[d];
                if (point[d] > most) most = point[d];
            }
            uint64_t& oldest = levels[level].oldest[node][lane];
            oldest = std::min(oldest, points.ages[entry]);
            node = child(level, node)[lane];
        }
        put_entry(points, node, used(0, node), entry);
    }

    // Sends for the leaves where these points would go, and for what leads there.
    void send_for_leaves(const std::vector<const float*>& at) const {
        std::vector<uint32_t> node(at.size(), root);
        for (size_t level = top(); level > 0; --level)
            for (size_t i = 0; i < at.size(); ++i) {
                const size_t lane = nearest_lane(level, node[i], at[i], 0);
                __builtin_prefetch(&levels[level].oldest[node[i]][lane]);
                node[i] = levels[level].child[node[i]][lane];
                send_for(level - 1, node[i]);
            }
    }

    // Makes two nodes, in the last two lanes, of the one in a lane: its lanes move where a plane parts them well, else
    // its entries are divided and both halves built anew. Returns the first of those lanes.
    size_t split(const Points& points, size_t level, size_t node, size_t lane) {
        const uint32_t below = child(level, node)[lane];
        for (size_t i = 0; level == 1 && i < lanes; ++i)  // enclose() will ask for them
            __builtin_prefetch(&points.ages[child(0, below)[i]]);
        const Parting parting = best_parting(level, node, lane);
        erase_lane(level, node, lane);
        const size_t first = used(level, node);
        if (parting.overlap <= tolerance) {
            const uint32_t halves[2] = {add_node(level - 1), add_node(level - 1)};
            for (size_t i = 0; i < lanes; ++i) {
                const bool upper = i >= parting.first;
                move_lane(level - 1, below, parting.order[i].second, halves[upper], upper ? i - parting.first : i);
            }
            release(level - 1, below);
            for (size_t half = 0; half < 2; ++half) put_node(points, level, node, first + half, halves[half]);
        } else {
            Order order;
            take_apart(level - 1, below, order);
            const Iterator middle = order.begin() + static_cast<ptrdiff_t>(order.size() / 2);
            cut(points, order.begin(), middle, order.end());
            put_node(points, level, node, first, build_node(points, level - 1, order.begin(), middle));
            put_node(points, level, node, first + 1, build_node(points, level - 1, middle, order.end()));
        }
        return first;
    }

    struct Parting {
        float overlap = INFINITY;         // part of the extent in the dimension of the plane
        size_t first = 0;                 // lanes on its lower side
        std::array<Ranked, lanes> order;  // (centre, lane)
    };

    // Of the planes that part the node in a lane and leave enough of its lanes on both sides: a tolerable or else the
    // least overlap, then the widest dimension, then the most even halves.
    Parting best_parting(size_t level, size_t node, size_t lane) {
        const uint32_t below = child(level, node)[lane];
        std::vector<Ranked> widest;  // dimensions, by minus their extent
        for (uint32_t d = 0; d < dim; ++d)
            widest.push_back({low(level, node, d)[lane] - high(level, node, d)[lane], d});
        std::sort(widest.begin(), widest.end());
        Parting best;
        for (size_t w = 0; w < dim && widest[w].first < 0.0f && best.overlap > tolerance; ++w) {
            const size_t d = widest[w].second;
            const Lanes<float>&lows = low(level - 1, below, d), &highs = high(level - 1, below, d);
            Parting next;
            for (uint32_t i = 0; i < lanes; ++i) next.order[i] = {0.5f * lows[i] + 0.5f * highs[i], i};
            std::sort(next.order.begin(), next.order.end());
            Lanes<float> most = {}, least = {};  // of the lanes up to i, of those from i on
            for (size_t i = 0; i < lanes; ++i)
                most[i] = std::max(highs[next.order[i].second], i > 0 ? most[i - 1] : -INFINITY);
            for (size_t i = lanes; i-- > 0;)
                least[i] = std::min(lows[next.order[i].second], i + 1 < lanes ? least[i + 1] : INFINITY);
            for (size_t i = 0; i <= lanes - 2 * fewest; ++i) {  // 8, 7, 9, 6, 10 ...
                next.first = i % 2 ? lanes / 2 - (i + 1) / 2 : lanes / 2 + i / 2;
                next.overlap = std::max(tolerance, (most[next.first - 1] - least[next.first]) / -widest[w].first);
                if (next.overlap < best.overlap) best = next;
            }
        }
        return best;
    }

    void release(size_t level, uint32_t node) {
        for (size_t lane = 0; lane < lanes; ++lane) clear_lane(level, node, lane);
        levels[level].unused.push_back(node);
    }

    // Appends the entries below a node, and gives up the nodes.
    void take_apart(size_t level, uint32_t node, Order& order) {
        for (size_t lane = 0, end = used(level, node); lane < end; ++lane) {
            const uint32_t what = child(level, node)[lane];
            if (level == 0) order.push_back({0.0f, what});
            if (level > 0) take_apart(level - 1, what, order);
        }
        release(level, node);
    }

    void remove(const Points& points, uint32_t entry) {
        const uint32_t leaf = levels[0].home[entry];
        erase_lane(0, leaf, lane_of(0, leaf, entry));
        tidy(points, 0, leaf);
    }

    // After a lane has gone, or its box has shrunk: a node with too few lanes is given up, and what it held put back.
    void tidy(const Points& points, size_t level, uint32_t node) {
        if (level == top()) {
            if (level > 0 && used(level, node) == 1) root = child(level, node)[0], levels.pop_back();
            return;
        }
        const uint32_t parent = levels[level + 1].home[node];
        const size_t lane = lane_of(level + 1, parent, node);
        if (used(level, node) >= fewest) {
            if (enclose(points, level + 1, parent, lane)) tidy(points, level + 1, parent);
            return;
        }
        Order order;
        take_apart(level, node, order);
        erase_lane(level + 1, parent, lane);
        tidy(points, level + 1, parent);
        for (const auto& [coordinate, entry] : order) insert(points, entry);
    }

    // ---- searching

    // Squared distances from a point to the boxes of a node; in level 0 to its entries, as squared_distance() has them.
    // To a box: never above the computed distance of any point x inside. For the nearest point c of the box,
    // |point - c| <= |point - x| in each coordinate, and rounding, being monotone and odd, keeps this <=, as do squaring
    // and adding in the same order with the rounding after each.
    [[gnu::always_inline]] inline Lanes<float> distances(size_t level, size_t node, const float* point) const {
        const size_t step = sides(level);
        const Lanes<float>* box = &levels[level].boxes[node * dim * step];
        Lanes<float> sum = {};
        for (size_t d = 0; d < dim; ++d, box += step) {
            const float x = point[d], *lows = box[0].data(), *highs = box[step - 1].data();
#pragma GCC unroll 1  // vectors of lanes, not of dimensions
            for (size_t i = 0; i < lanes; ++i) {
                const float gap = x - std::min(std::max(x, lows[i]), highs[i]);
                sum[i] += gap * gap;
            }
        }
        return sum;
    }

    // One bit for each lane of which `holds` is true.
    template <class Condition>
    [[gnu::always_inline]] static uint32_t lanes_where(Condition holds) {
        static constexpr auto bits = [] {  // a table, not a shift: vectors of old cannot shift by lanes
            std::array<int32_t, lanes> table = {};
            for (size_t i = 0; i < lanes; ++i) table[i] = 1 << i;
            return table;
        }();
        int32_t mask = 0;
#pragma GCC unroll 1
        for (size_t i = 0; i < lanes; ++i) mask |= bits[i] & -static_cast<int32_t>(holds(i));
        return static_cast<uint32_t>(mask);
    }

    // The least of the distances. None is negative, so their bits, read as whole numbers, are in the same order; of
    // those GCC finds the least by vectors.
    [[gnu::always_inline]] static float least_of(const Lanes<float>& distance) {
        int32_t least = std::numeric_limits<int32_t>::max();
#pragma GCC unroll 1
        for (size_t i = 0; i < lanes; ++i) least = std::min(least, std::bit_cast<int32_t>(distance[i]));
        return std::bit_cast<float>(least);
    }

    // So that the node comes from memory while something else is done; into a core's second cache: what all walks of a
    // search send for does not fit the first.
    [[gnu::always_inline]] inline void send_for(size_t level, size_t node) const {
        const size_t lines = dim * sides(level);
        for (size_t i = 0; i < lines; ++i) __builtin_prefetch(&levels[level].boxes[node * lines + i], 0, 2);
        __builtin_prefetch(&levels[level].child[node], 0, 2);
    }

    // Of the lanes from `first` on. Ties: the first.
    EACH_TARGET size_t nearest_lane(size_t level, size_t node, const float* point, size_t first) const {
        Lanes<float> distance = distances(level, node, point);
#pragma GCC unroll 1
        for (uint32_t i = 0; i < lanes; ++i) distance[i] = i < static_cast<uint32_t>(first) ? INFINITY : distance[i];
        const float least = least_of(distance);
        const uint32_t nearest = lanes_where([&](size_t i) { return distance[i] == least; });
        return static_cast<size_t>(std::countr_zero(nearest >> first)) + first;
    }

    // A node on the way from the root to where a search is, and what it has not yet opened there.
    struct Stage {
        Lanes<float> distance;  // of its lanes; INFINITY: opened, or empty, or too far for a float; none is ever opened
        float least;            // of them
        size_t node;
    };

    // A search under way.
    struct Walk {
        Query* query;
        float reach;             // what is farther does not count
        size_t level;            // where it is, at way[level]
        std::vector<Stage> way;  // [level]
    };

    // The K nearest entries to each point, but only those nearer than `limit`. Several walks take turns, so that the
    // next node of each comes from memory while the others compute. All of them scan before any decides: no branch in a
    // scan depends on what is found, so that one foreseen wrongly costs no distances.
    EACH_TARGET void search(const Points& points, std::vector<Query>& queries, size_t K, float limit) const {
        std::vector<Walk> walks(std::min<size_t>(queries.size(), 16));
        size_t begun = 0;
        const auto begin = [&](Walk& walk) {
            walk = {&queries[begun++], limit, top(), std::move(walk.way)};
            walk.way.resize(levels.size());
            walk.way[walk.level].node = root;
        };
        for (Walk& walk : walks) begin(walk);
        while (!walks.empty()) {
            for (Walk& walk : walks) scan(walk);
            for (size_t i = 0; i < walks.size();) {
                Walk& walk = walks[i];
                if (walk.level == 0) take_entries(points, walk, K);
                if (open_next(points, walk, K)) {
                    ++i;
                } else if (begun < queries.size()) {
                    begin(walk), ++i;
                } else {
                    std::swap(walk, walks.back());
                    walks.pop_back();
                }
            }
        }
    }

    [[gnu::always_inline]] inline void scan(Walk& walk) const {
        Stage& stage = walk.way[walk.level];
        stage.distance = distances(walk.level, stage.node, walk.query->point);
        stage.least = least_of(stage.distance);
    }

    // Whether an entry, or a box whose oldest entry is that old, can be among the K nearest. At equal distances the
    // older wins; the age is a reference because it lies elsewhere, and is seldom asked for.
    [[gnu::always_inline]] static bool counts(const Points& points, const Walk& walk, size_t K, float distance,
                                              const uint64_t& age) {
        if (distance != walk.reach) return distance < walk.reach;
        return walk.query->found == K && age < points.ages[walk.query->best[K - 1].entry];
    }

    [[gnu::always_inline]] inline void take_entries(const Points& points, Walk& walk, size_t K) const {
        walk.level = 1;  // back to the node above; past the end if the leaf is the root
        const Stage& stage = walk.way[0];
        if (!(stage.least <= walk.reach)) return;  // as in most leaves
        Query& query = *walk.query;
        for (uint32_t mask = lanes_where([&](size_t i) { return stage.distance[i] <= walk.reach; }); mask != 0;
             mask &= mask - 1) {
            const size_t lane = static_cast<size_t>(std::countr_zero(mask));
            const Neighbour next = {stage.distance[lane], levels[0].child[stage.node][lane]};
            if (next.entry == query.skipped || next.entry == no_entry) continue;
            if (!counts(points, walk, K, next.distance, points.ages[next.entry])) continue;
            size_t k = query.found < K ? query.found++ : K - 1;
            for (; k > 0 && points.closer(next, query.best[k - 1]); --k) query.best[k] = query.best[k - 1];
            query.best[k] = next;
            if (query.found == K) walk.reach = query.best[K - 1].distance;
        }
    }

    // Goes to the next box that counts, and sends for its node. Of equally near ones it is the one with the oldest
    // entry: if that does not count, none of them does. Returns whether there is one.
    [[gnu::always_inline]] inline bool open_next(const Points& points, Walk& walk, size_t K) const {
        for (; walk.level < levels.size(); ++walk.level) {
            Stage& stage = walk.way[walk.level];
            if (!(stage.least <= walk.reach)) continue;  // NaN: the point is infinite, and nothing near it
            const Level& level = levels[walk.level];
            const Lanes<uint64_t>& oldest = level.oldest[stage.node];
            uint32_t nearest = lanes_where([&](size_t i) { return stage.distance[i] == stage.least; });
            size_t lane = static_cast<size_t>(std::countr_zero(nearest));
            while ((nearest &= nearest - 1) != 0)
                if (const auto i = static_cast<size_t>(std::countr_zero(nearest)); oldest[i] < oldest[lane]) lane = i;
            if (!counts(points, walk, K, stage.least, oldest[lane])) continue;
            const uint32_t node = level.child[stage.node][lane];
            send_for(walk.level - 1, node);
#pragma GCC unroll 1  // the whole vector: after a store of one lane, loading the vector would wait for it
            for (size_t i = 0; i < lanes; ++i) stage.distance[i] = i == lane ? INFINITY : stage.distance[i];
            stage.least = least_of(stage.distance);
            walk.way[--walk.level].node = node;
            return true;
        }
        return false;
    }

    size_t bytes() const {
        size_t total = 0;
        const auto add = [&](const auto& column) { total += column.capacity() * sizeof(column[0]); };
        for (const Level& level : levels)
            add(level.boxes), add(level.child), add(level.oldest), add(level.home), add(level.unused);
        return total;
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

// K(s_q) of many queries s_q.
struct Neighbourhoods {
    size_t K = 0;
    std::vector<Neighbour> rows = {};  // [query, K], closest first
    std::vector<size_t> counts = {};   // [query] how many of a row are in use

    size_t size() const { return counts.size(); }
    std::span<const Neighbour> operator[](size_t i) const { return {rows.data() + i * K, counts[i]}; }
};

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
    BoxTree tree;                 // over `projected`

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
        // Sixteen states at a time: what they will touch comes from memory for all of them at once. No more than a
        // hint: one may be evicted before its turn, or another change the leaf where it will go.
        std::array<Words4, 16> key;
        std::vector<float> point(key.size() * dim);
        std::vector<const float*> unknown;
        for (size_t first = 0; first < T; first += key.size()) {
            const size_t n = std::min(key.size(), T - first);
            for (size_t i = 0; i < n; ++i) {
                key[i] = state_key(&trajectory.states[(first + i) * S], S);
                project(&trajectory.states[(first + i) * S], &point[i * dim]);
                __builtin_prefetch(&slots[key[i][0] & (slots.size() - 1)]);
            }
            unknown.clear();
            for (size_t i = 0; i < n; ++i)
                if (slots[find_slot(key[i])] == no_entry) unknown.push_back(&point[i * dim]);
            tree.send_for_leaves(unknown);
            for (size_t i = 0, t = first; i < n; ++i, ++t)
                update_one(changes, key[i], &point[i * dim], &trajectory.actions[t * A],
                           trajectory.discounted_returns[t]);
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

    // The same from the tree, for many points at once.
    Neighbourhoods nearest(const std::vector<float>& at, const std::vector<uint32_t>& skipped) const {
        Neighbourhoods found{static_cast<size_t>(config.K), {}, {}};
        found.rows.resize(skipped.size() * found.K);
        std::vector<Query> queries;
        for (size_t i = 0; i < skipped.size(); ++i)
            queries.push_back({&at[i * dim], skipped[i], &found.rows[i * found.K]});
        // The smallest float that is not below epsilon: the same floats are below both.
        float limit = static_cast<float>(std::min<double>(config.epsilon, std::numeric_limits<float>::max()));
        if (limit < config.epsilon) limit = std::nextafter(limit, INFINITY);
        tree.search(points(), queries, found.K, limit);
        for (const Query& query : queries) found.counts.push_back(query.found);
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

    // exp(-q_k) over exp(-q_1), the largest: the quotient in (5) is the same and no epsilon can make it 0 / 0. The float
    // exp: libm's in double gives other bits on other processors. Sums are in double.
    static double similarity(std::span<const Neighbour> found, size_t k) {
        return std::exp(found[0].distance - found[k].distance);
    }

    // WODTEM eq. (5): e-hat(s_q) = sum_k p_k e_k, p_k = exp(-q(s_q, s_k)) / sum_k1 exp(-q(s_q, s_k1)).
    // NaN, that is unknown, for an empty K(s_q).
    double approximate_return(std::span<const Neighbour> found) const {
        double sum = 0.0, normaliser = 0.0;
        for (size_t k = 0; k < found.size(); ++k) {
            sum += similarity(found, k) * e[found[k].entry];
            normaliser += similarity(found, k);
        }
        return sum / normaliser;
    }

    // WODTEM eq. (6): p(a_k^e | s_q, s_k, e_k) = exp(e_k / tau) / sum_k1 exp(e_k1 / tau); a-hat(s_q) is drawn from it.
    // e reaches thousands, exp(89) overflows float: the largest e is subtracted first. Returns action_dim numbers.
    const float* remembered_action(std::span<const Neighbour> found, double uniform) const {
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
    bool is_optimal(std::span<const Neighbour> found, double d) const {
        double excess = 0.0;
        for (size_t k = 0; k < found.size(); ++k) excess += similarity(found, k) * (e[found[k].entry] - d);
        return excess <= 0.0;
    }

    // WODTEM eq. (7): w(s, a) = 1 if d >= e-hat(s), else alpha.
    double weight(std::span<const Neighbour> found, double d, double alpha) const {
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
        tree.build(points(), dim, static_cast<uint32_t>(n));
    }

    // Bytes of memory in use, derived state included.
    size_t bytes() const {
        size_t total = 0;
        const auto add = [&](const auto& column) { total += column.capacity() * sizeof(column[0]); };
        for_each_column(*this, [&](const char*, const auto& column, size_t) { add(column); });
        add(projection), add(slots), add(heap);
        return total + tree.bytes();
    }
};
