// memory.hpp: trajectories and their returns, environments and episodes, the replay buffer D, the episodic memory Q.
//   sec. III-A      g_t and d_t                     returns_to_go, discounted_returns, relabel
//   sec. III-A      D_offline, D_online             offline_set, ReplayBuffer
//   sec. III-B      interaction                     Environment, Episode, play
//   sec. IV-B.1     the table Q, eq. (4)            EpisodicMemory::update_one (the paper's rule between (3) and (5))
//   sec. IV-B.2     K(s_q), eqs. (5) and (6)        nearest, search, is_optimal, advised_action
//   sec. IV-B.3     eq. (7)                         weight
// Promises: exact nearest neighbours; every tie has a stated winner, so results depend on the order of updates and
// look-ups and on nothing else (not on when the search tree was built, not on a save and load in between); a refused
// trajectory leaves the table as it was; many threads may call search() at once. Leaves out: networks, files.
// Memory: the columns of EpisodicMemory, and about as much again for what is derived from them. Times: tests/BENCH.md.
#pragma once

#include <exception>
#include <limits>
#include <queue>
#include <span>

#include "nn.hpp"  // and with it the other standard headers

// The streams of random numbers beside those of nn.hpp. The values are part of the format of a run; never renumber.
namespace Stream {
constexpr uint32_t batch = 3;           // step: update; index: window of the batch; site 1: the start, if uniform
constexpr uint32_t exploration = 4;     // step: episode; site: action dimension; index: time-step
constexpr uint32_t advised_action = 5;  // eq. (6). step: update; index: window * context_length + step in the window
constexpr uint32_t entropy_noise = 6;   // the same; site: action dimension
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

// Refuses a column without `width` finite numbers for each of `steps` steps. Errors: memory.shape, memory.not_finite.
void check_column(const char* what, const auto& column, size_t steps, size_t width) {
    if (column.size() != steps * width)
        fail("memory.shape", "%zu %s for %zu steps, expected %zu", column.size(), what, steps, steps * width);
    for (size_t i = 0; i < column.size(); ++i)
        if (!std::isfinite(column[i]))
            fail("memory.not_finite", "%s[%zu] is %g; only finite numbers can be remembered", what, i,
                 double{column[i]});
}

// Validates a trajectory and computes both returns from its rewards; targets used while acting play no part.
// Errors: memory.shape, memory.not_finite.
inline void relabel(Trajectory& trajectory, int state_dim, int action_dim, double gamma) {
    const size_t T = trajectory.rewards.size();
    if (T == 0) fail("memory.shape", "a trajectory has no steps, expected at least one");
    check_column("states", trajectory.states, T, state_dim);
    check_column("actions", trajectory.actions, T, action_dim);
    check_column("rewards", trajectory.rewards, T, 1);
    trajectory.returns_to_go = returns_to_go(trajectory.rewards);
    trajectory.discounted_returns = discounted_returns(trajectory.rewards, gamma);
}

// WODTEM sec. III-A: the total return is g_1. Errors: memory.not_relabelled.
inline double total_return(const Trajectory& trajectory) {
    if (trajectory.returns_to_go.empty()) fail("memory.not_relabelled", "a trajectory has no returns: relabel it");
    return trajectory.returns_to_go.front();
}

// Orders trajectories by total return.
inline bool lower_return(const Trajectory& a, const Trajectory& b) { return total_return(a) < total_return(b); }

// ODT's loop that keeps trajectories, best first, stops one short: exactly the lowest-return one is dropped, unless it
// is the only one. Of several lowest, the first in the data set goes. The others stay in the order of the data set.
inline std::vector<Trajectory> offline_set(std::vector<Trajectory> trajectories, bool keep_lowest) {
    if (!keep_lowest && trajectories.size() > 1)
        trajectories.erase(std::min_element(trajectories.begin(), trajectories.end(), lower_return));
    return trajectories;
}

// ---------------------------------------------------------------------------------------------------------------------
// Environments and episodes.

constexpr uint64_t data_set_episodes = uint64_t{1} << 41;  // the numbers of a data set's episodes start here

struct EnvironmentSpec {
    int state_dim;          // floats per state
    int action_dim;         // floats per stored action; a discrete action is one float, its index
    int discrete_actions;   // how many there are to choose from; 0: actions are continuous
    int max_episode_steps;  // the time limit, in steps
};

struct Step {
    double reward;
    bool terminated;  // the task ended the episode; running into the time limit is not termination
};

// Every task offers these four operations. An object plays one episode at a time and does not count the time limit.
struct Environment {
    virtual ~Environment() = default;
    virtual EnvironmentSpec spec() const = 0;
    // Begins an episode and writes its first state [state_dim], which is a function of (random, episode).
    virtual void reset(const Random& random, uint64_t episode, float* state) = 0;
    // Takes an action [action_dim] and writes the state [state_dim] that follows. Errors: environment.unstable where
    // the simulation broke down; the caller must then drop the episode. Any other error ends the run.
    virtual Step step(const float* action, float* state) = 0;
    virtual std::unique_ptr<Environment> clone() const = 0;
};

// One episode: the steps made so far and the present state.
struct Episode {
    uint64_t number = 0;         // which decides its first state and all its random numbers
    Trajectory trajectory;       // the steps made so far, without returns
    std::vector<float> state;    // [state_dim] the present state
    std::vector<float> targets;  // [t + 1] scaled returns-to-go that a return-conditioned policy was given, else empty
    double reward = 0;           // of the latest step; the trajectory holds it as a float
    double total_reward = 0;     // of all steps so far, undiscounted
    bool over = false;           // by termination or by an error
    std::string error;           // the sentence of environment.unstable, else empty
    std::exception_ptr thrown;   // what step() caught, for take_error() to throw in the caller's thread

    // Takes one step of the environment, which must be in the state that this episode holds. Throws nothing; the
    // caller's thread then calls take_error().
    void step(Environment& environment, const float* action, int action_dim) {
        reward = 0;
        try {
            trajectory.states.insert(trajectory.states.end(), state.begin(), state.end());
            trajectory.actions.insert(trajectory.actions.end(), action, action + action_dim);
            trajectory.rewards.push_back(0);
            const Step step = environment.step(action, state.data());
            reward = step.reward;
            over = trajectory.terminated = step.terminated;
        } catch (...) {
            over = true;
            thrown = std::current_exception();
            return;
        }
        trajectory.rewards.back() = static_cast<float>(reward);
        total_reward += reward;
    }

    // Moves the sentence of environment.unstable that step() met to `error`. Errors: any other that it met.
    void take_error() {
        try {
            if (thrown) std::rethrow_exception(std::exchange(thrown, nullptr));
        } catch (const Error& failure) {
            if (failure.id != "environment.unstable") throw;
            error = failure.what();
        }
    }
};

// Copies of an environment, for episodes side by side.
struct Environments {
    std::vector<std::unique_ptr<Environment>> copies;
    std::vector<Environment*> pointers;

    Environments(const Environment& environment, int64_t count) {
        for (int64_t i = 0; i < count; ++i) pointers.push_back(copies.emplace_back(environment.clone()).get());
    }
    std::span<Environment* const> all() const { return pointers; }
    std::span<Environment* const> first() const { return all().first(1); }
};

// Plays one episode in each environment, numbered from `first` on, in lockstep up to termination or the time limit.
// choose(running) returns the actions [running.size(), action_dim] of the episodes that are not over. Errors: what
// reset() throws, and take_error().
std::vector<Episode> play(std::span<Environment* const> environments, const Random& resets, uint64_t first,
                          auto&& choose, Threads* threads) {
    const EnvironmentSpec spec = environments[0]->spec();
    std::vector<Episode> episodes(environments.size());
    std::vector<Episode*> running;
    for (size_t i = 0; i < episodes.size(); ++i) {
        episodes[i].number = first + i;
        episodes[i].state.resize(spec.state_dim);
        environments[i]->reset(resets, first + i, episodes[i].state.data());
        running.push_back(&episodes[i]);
    }
    for (int t = 0; t < spec.max_episode_steps && !running.empty(); ++t) {
        const std::vector<float> actions = choose(std::span<Episode* const>(running));
        threads->run(static_cast<int>(running.size()), [&](int i, int) {
            Environment& environment = *environments[running[i] - episodes.data()];
            running[i]->step(environment, &actions[i * spec.action_dim], spec.action_dim);
        });
        for (Episode* episode : running) episode->take_error();
        std::erase_if(running, [](const Episode* episode) { return episode->over; });
    }
    return episodes;
}

// The same for one environment: choose(episode) returns one action [action_dim].
Episode play(Environment& environment, const Random& resets, uint64_t number, auto&& choose) {
    Environment* const environments[] = {&environment};
    Threads alone(1);
    return std::move(play(
        environments, resets, number, [&](auto running) { return choose(*running[0]); }, &alone)[0]);
}

// ---------------------------------------------------------------------------------------------------------------------
// Replay buffer: D_offline when capacity is the size of the offline set, D_online otherwise.

struct Window {
    size_t trajectory;
    int start, length;  // steps; start counts from 0
};

// How a trajectory is drawn from the buffer: with probability proportional to its length, as DT's and ODT's code, or
// each alike, as min-decision-transformer. The paper does not say. Drawn alike, a step of a trajectory of T steps
// counts 1 / T, so that short episodes weigh more.
enum class Sampling { by_length, uniform };

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
        candidates.erase(candidates.begin(), candidates.end() - std::min(capacity, candidates.size()));
        trajectories = std::move(candidates);
        next = 0;
        count_steps();
    }

    // WODTEM sec. III-A, D_online: first in, first out: append until full, then overwrite from 0 up, lap after lap.
    void add(Trajectory trajectory) {
        if (trajectories.size() < capacity) {
            trajectories.push_back(std::move(trajectory));
        } else {
            trajectories[next] = std::move(trajectory);
            next = (next + 1) % capacity;
        }
        count_steps();
    }

    // Computes `ends` anew, after any change of `trajectories`.
    void count_steps() {
        ends.clear();
        uint64_t steps = 0;
        for (const Trajectory& trajectory : trajectories) ends.push_back(steps += trajectory.rewards.size());
    }

    // WODTEM sec. III-B, C^t: the steps of a sub-trajectory. A trajectory is drawn, and a start uniformly from its
    // steps; the window is the next min(context_length, steps left) steps, so those near the end are short.
    // departs from the paper: as ODT's code does, not the latest C steps up to t, which are short at the beginning.
    // by_length: one number drawn from all steps laid end to end has exactly these probabilities, for each step is one
    // start. uniform: a second number, of site 1, draws the start.
    Window sample(const Random& random, uint64_t update, uint32_t window_index, int context_length,
                  Sampling sampling) const {
        if (trajectories.empty()) fail("replay.empty", "cannot sample: the replay buffer holds no trajectory");
        if (sampling == Sampling::by_length)
            return window_at(random.below(ends.back(), update, window_index), context_length);
        const size_t drawn = random.below(trajectories.size(), update, window_index);
        const uint64_t first = steps_before(drawn), length = ends[drawn] - first;
        return window_in(drawn, first + random.below(length, update, window_index, 1), context_length);
    }

    // The window that starts at a step, 0 <= step < ends.back(), of all trajectories laid end to end.
    Window window_at(uint64_t step, int context_length) const {
        const auto end = std::upper_bound(ends.begin(), ends.end(), step);  // the first trajectory to end after `step`
        return window_in(static_cast<size_t>(end - ends.begin()), step, context_length);
    }

    // The same, of the trajectory that the step lies in. Reads `ends` alone: trajectories are rarely in the cache.
    Window window_in(size_t trajectory, uint64_t step, int context_length) const {
        const int start = static_cast<int>(step - steps_before(trajectory));
        const int left = static_cast<int>(ends[trajectory] - step);
        return {trajectory, start, std::min(context_length, left)};
    }
    uint64_t steps_before(size_t trajectory) const { return trajectory == 0 ? 0 : ends[trajectory - 1]; }
};

// ---------------------------------------------------------------------------------------------------------------------
// Exact nearest neighbours. Distances are squared, in float32, summed in the order of the dimensions.

constexpr uint32_t no_entry = 0xFFFFFFFF;

struct Neighbour {
    float distance;  // q(s_q, s_k) = ||s_q - s_k||^2, in the projected space
    uint32_t entry;
};

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
    size_t dim;

    float at(size_t entry, size_t d) const { return rows[entry * dim + d]; }
    // The order of neighbours. Ties: smaller distance, then older entry.
    bool closer(const Neighbour& a, const Neighbour& b) const {
        return a.distance < b.distance || (a.distance == b.distance && ages[a.entry] < ages[b.entry]);
    }
};

// A bucket k-d tree (Friedman, Bentley and Finkel, 1977), kept balanced by partial rebuilding (Overmars, 1983). An
// inner node divides its entries by the order of (coordinate, entry number), so identical points are divided like any
// others, and an entry belongs to exactly one leaf. A leaf holds up to 16 entries; their coordinates lie side by side,
// so that one pass of vector code gives all distances. An inner node holds more than 8, and neither of its children
// more than two thirds of them, rounded up; the highest node that breaks this is built anew. Insertions and removals
// take O(log(n)^2) amortised, whatever their order. No result depends on the tree's shape.
struct KdTree {
    static constexpr uint32_t lanes = 16;         // entries in a full leaf
    static constexpr uint32_t leaf = 0xFFFFFFFF;  // stands for `axis` in a leaf
    static constexpr size_t longest_path = 48;  // planes above a leaf: 2/3 (rounded up) of 2^31 - 1 is 8 after 48 times
    template <class Number>
    struct alignas(64) LeafArray : std::array<Number, lanes> {};
    struct Node {
        uint32_t child;  // inner node: its low child, the high child follows it. Leaf: its place in the arrays below
        uint32_t axis;   // inner node: the dimension that divides its entries
        float split;     // inner node: the high child's entries begin at (split, split_entry[node]) in the order above
        uint32_t count;  // entries below it, or in the leaf
    };
    std::vector<Node> nodes;                    // nodes 2 p and 2 p + 1, a pair, are siblings; node 0 is the root
    std::vector<uint32_t> split_entry;          // [node] the entry that the plane goes through
    std::vector<LeafArray<float>> coordinates;  // [place, dim]
    std::vector<LeafArray<uint32_t>> entries;   // [place] there is one place for each pair
    std::vector<uint32_t> free_pairs;

    // Makes a node of the entries in `order`: halves them along the dimension of the largest extent until they fit
    // leaves. The low child gets the node's place and the high child that of the new pair.
    void build_node(const Points& points, uint32_t node, uint32_t place, std::span<uint32_t> order) {
        nodes[node] = {place, leaf, 0.0f, static_cast<uint32_t>(order.size())};
        if (order.size() <= lanes) {
            for (size_t lane = 0; lane < order.size(); ++lane) put(points, place, lane, order[lane]);
            return;
        }
        std::pair<float, uint32_t> widest = {};  // (extent, dimension)
        for (uint32_t d = 0; d < points.dim; ++d) {
            float least = INFINITY, most = -INFINITY;
            for (const uint32_t entry : order) {
                least = std::min(least, points.at(entry, d));
                most = std::max(most, points.at(entry, d));
            }
            widest = std::max(widest, {most - least, d});
        }
        const uint32_t axis = widest.second, pair = take_pair(points.dim);
        const auto half = order.begin() + static_cast<ptrdiff_t>(order.size() / 2);
        std::ranges::nth_element(order, half, {}, [&](uint32_t i) { return std::pair(points.at(i, axis), i); });
        nodes[node] = {2 * pair, axis, points.at(*half, axis), nodes[node].count};
        split_entry[node] = *half;
        build_node(points, 2 * pair, place, {order.begin(), half});
        build_node(points, 2 * pair + 1, pair, {half, order.end()});
    }

    // A free pair of nodes and its place for a leaf; enlarges the arrays if there is none. dim: of the points.
    uint32_t take_pair(size_t dim) {
        if (free_pairs.empty()) {
            free_pairs.push_back(static_cast<uint32_t>(entries.size()));
            nodes.resize(nodes.size() + 2);
            split_entry.resize(nodes.size());
            coordinates.resize(coordinates.size() + dim);
            entries.emplace_back();
        }
        const uint32_t pair = free_pairs.back();
        free_pairs.pop_back();
        return pair;
    }

    // Writes an entry into one lane of the leaf at `place`.
    void put(const Points& points, size_t place, size_t lane, uint32_t entry) {
        entries[place][lane] = entry;
        for (size_t d = 0; d < points.dim; ++d) coordinates[place * points.dim + d][lane] = points.at(entry, d);
    }

    // The leaf of an entry, and the highest node above it that loses its balance when the counts of the nodes above the
    // leaf change by `change`, which they do; where none does, the leaf again.
    std::pair<uint32_t, uint32_t> descend(const Points& points, uint32_t entry, int change) {
        uint32_t at = 0, highest = no_entry;
        while (nodes[at].axis != leaf) {
            const uint32_t count = nodes[at].count += change;
            const float x = points.at(entry, nodes[at].axis);
            const bool high = x == nodes[at].split ? entry >= split_entry[at] : x > nodes[at].split;
            const uint32_t next = nodes[at].child + high;
            const uint32_t heavier = std::max(nodes[next].count + change, nodes[next ^ 1].count);
            if (highest == no_entry && (count <= lanes / 2 || heavier > count - count / 3)) highest = at;
            at = next;
        }
        return {at, highest == no_entry ? at : highest};
    }

    // Adds an entry whose row `points` holds already.
    void insert(const Points& points, uint32_t entry) {
        const auto [at, highest] = descend(points, entry, 1);
        if (highest == at && nodes[at].count < lanes) return put(points, nodes[at].child, nodes[at].count++, entry);
        rebuild(points, highest, {entry});
    }

    // Takes an entry out; its row must be the one that it was inserted with.
    void remove(const Points& points, uint32_t entry) {
        const auto [at, highest] = descend(points, entry, -1);
        const LeafArray<uint32_t>& held = entries[nodes[at].child];
        const auto lane = std::ranges::find(held, entry) - held.begin();
        put(points, nodes[at].child, lane, held[--nodes[at].count]);
        if (highest != at) rebuild(points, highest, {});
    }

    // Builds a node anew, of the entries below it and those in `order`.
    void rebuild(const Points& points, uint32_t node, std::vector<uint32_t> order) {
        const uint32_t place = collect(node, order);
        build_node(points, node, place, order);
    }

    // Appends the entries below a node to `order`, frees the pairs below, and returns the place that the node got.
    uint32_t collect(uint32_t index, std::vector<uint32_t>& order) {
        const Node node = nodes[index];
        if (node.axis == leaf) {
            order.insert(order.end(), entries[node.child].begin(), entries[node.child].begin() + node.count);
            return node.child;
        }
        free_pairs.push_back(node.child / 2);
        collect(node.child + 1, order);
        return collect(node.child, order);
    }
};

// A query on its way through a tree.
struct Walk {
    struct Subtree {
        float distance;  // to the plane before it, squared
        uint32_t node;
    };
    size_t query;          // its index among the queries
    const float* point;    // [dim]
    uint32_t skipped;      // the entry that is no neighbour
    float reach;           // an entry farther away is none either
    Subtree* subtrees;     // [KdTree::longest_path] a stack of those still to be visited
    size_t waiting = 0;    // its height
    uint32_t at = 0;       // the node to be visited next
    bool fetched = false;  // if `at` is a leaf: whether it has been prefetched

    // Visits one node; returns whether there is another to visit. A subtree beyond a plane can be left out if the plane
    // is too far: a point beyond has a coordinate at least that far, and rounding, being monotone, keeps that order in
    // the difference, in its square and in a sum of squares. At equal distances the older entry wins: hence not >=.
    ALWAYS_INLINE bool step(const KdTree& tree, const Points& points, Neighbourhoods& found) {
        const KdTree::Node& node = tree.nodes[at];
        if (node.axis != KdTree::leaf) {
            const float gap = point[node.axis] - node.split;
            at = node.child + (gap > 0.0f);
            subtrees[waiting++] = {gap * gap, at ^ 1};
            __builtin_prefetch(&tree.nodes[at]);
            return true;
        }
        if (!fetched) {
            for (size_t d = 0; d < points.dim; ++d) __builtin_prefetch(&tree.coordinates[node.child * points.dim + d]);
            __builtin_prefetch(&tree.entries[node.child]);
            return fetched = true;
        }
        fetched = false;
        scan(tree, node, points, found);
        while (waiting > 0 && subtrees[waiting - 1].distance > reach) --waiting;
        if (waiting == 0) return false;
        at = subtrees[--waiting].node;
        return true;
    }

    // Takes those entries of a leaf that are among the K nearest so far.
    // WODTEM sec. IV-B.2, q: q(s_q, s_k) = ||s_q - s_k||^2, not its root; of all entries of the leaf at once.
    ALWAYS_INLINE void scan(const KdTree& tree, const KdTree::Node& node, const Points& points, Neighbourhoods& found) {
        KdTree::LeafArray<float> distance = {};
        for (size_t d = 0; d < points.dim; ++d)
#pragma GCC unroll 1  // vectors of lanes, not of dimensions
            for (size_t i = 0; i < KdTree::lanes; ++i) {
                const float gap = tree.coordinates[node.child * points.dim + d][i] - point[d];
                distance[i] += gap * gap;
            }
        Neighbour* best = &found.rows[query * found.K];
        size_t& count = found.counts[query];
        for (size_t i = 0; i < node.count; ++i) {
            const Neighbour next = {distance[i], tree.entries[node.child][i]};
            if (!(next.distance <= reach) || next.entry == skipped) continue;
            if (count == found.K && !points.closer(next, best[count - 1])) continue;
            size_t k = count < found.K ? count++ : count - 1;
            for (; k > 0 && points.closer(next, best[k - 1]); --k) best[k] = best[k - 1];
            best[k] = next;
            if (count == found.K) reach = best[count - 1].distance;
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
    double tau = 1.0;           // divides e in eq. (6)'s softmax; the paper has none, which is 1
    bool exclude_self = false;  // the entry of the query state itself is no neighbour
    Eviction eviction = Eviction::lfu;
};

// "Exact state matching": two states are one when their float32 bits agree, -0 taken as +0. The key is 128 bits, each
// group of four numbers folded in by a permutation: h = philox(h xor group). Up to 4 dimensions nothing can collide;
// beyond, n states share a key by chance with probability n^2 / 2^129: 2e-26 for 4e6. It does not resist an adversary.
inline Words4 state_key(const float* state, size_t state_dim) {
    Words4 h = {};
    for (size_t i = 0; i < state_dim; ++i) {
        h[i % 4] ^= std::bit_cast<uint32_t>(state[i] + 0.0f);  // -0 + 0 = +0; nothing else changes
        if (i % 4 == 3 || i + 1 == state_dim) h = philox(h, static_cast<uint32_t>(state_dim), 0x574F4454);
    }
    return h;
}

struct EpisodicMemory {
    struct Changes {
        uint64_t inserted = 0, improved = 0, kept = 0, evicted = 0;  // entries; the first three sum to T
    };
    using HeapItem = std::tuple<uint64_t, uint64_t, uint32_t>;  // (priority, age, entry)

    MemoryConfig config;
    size_t S = config.state_dim, A = config.action_dim;
    size_t dim = config.projected_dim ? config.projected_dim : S;  // of the space that is searched
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
    // One item per entry, the smallest on top; empty until the first eviction.
    std::priority_queue<HeapItem, std::vector<HeapItem>, std::greater<>> heap;
    KdTree tree;  // over `projected`

    // Errors: memory.config. Reserves the memory for all entries, so that no update copies a column.
    EpisodicMemory(const MemoryConfig& c, uint32_t seed) : config(c) {
        if (c.state_dim < 1 || c.action_dim < 1 || c.K < 1 || c.projected_dim < 0 || c.capacity < 1 ||
            c.capacity > 0x7FFFFFFF || !(c.epsilon >= 0.0) || !(c.tau > 0.0))
            fail("memory.config",
                 "episodic memory needs state_dim, action_dim, K >= 1, capacity from 1 to 2^31 - 1, projected_dim, "
                 "epsilon >= 0, tau > 0; "
                 "got %d, %d, %d, %zu, %d, %g, %g",
                 c.state_dim, c.action_dim, c.K, c.capacity, c.projected_dim, c.epsilon, c.tau);
        // WODTEM sec. IV-B.1, projection: random, from R^F to R^F1. Variance 1 / F1 keeps the expected squared
        // distance, so that epsilon means the same before and after.
        const Random random{seed, Stream::projection};
        const double scale = 1.0 / std::sqrt(static_cast<double>(dim));
        projection.resize(config.projected_dim * S);
        for (uint32_t i = 0; i < projection.size(); ++i) projection[i] = scale * random.normal(0, i);
        for_each_column(*this, [&](auto, auto& column, size_t width) { column.reserve(config.capacity * width); });
        rebuild_derived();
    }

    size_t size() const { return e.size(); }
    Points points() const { return {projected.data(), age.data(), dim}; }

    // ---- eq. (4): the table

    // Every state of a relabelled trajectory, in the order of time. A look-up that nothing can satisfy comes first: it
    // brings the leaves to which the next 64 states belong into the cache, all at the same time.
    // Errors: memory.shape, memory.not_finite, both before anything is changed.
    Changes update(const Trajectory& trajectory) {
        const size_t T = trajectory.rewards.size();
        check_column("states", trajectory.states, T, S);
        check_column("actions", trajectory.actions, T, A);
        check_column("discounted returns", trajectory.discounted_returns, T, 1);
        Changes changes;
        for (size_t first = 0; first < T; first += 64) {
            const size_t n = std::min<size_t>(64, T - first);
            std::vector<Words4> key(n);
            std::vector<float> at(n * dim);
            for (size_t i = 0; i < n; ++i) {
                key[i] = state_key(&trajectory.states[(first + i) * S], S);
                __builtin_prefetch(&slots[key[i][0] & (slots.size() - 1)]);  // find_slot() looks there first
                project(&trajectory.states[(first + i) * S], &at[i * dim]);
            }
            nearest(at, std::vector(n, no_entry), -1.0f);
            for (size_t i = 0, t = first; i < n; ++i, ++t)
                update_one(changes, key[i], &at[i * dim], &trajectory.actions[t * A], trajectory.discounted_returns[t]);
        }
        return changes;
    }

    // WODTEM eq. (4): Q(s) <- Q(s) if stored and e >= d; (s, a, d) if stored and e < d; (s, a, d) if not stored. Equal
    // returns keep the older action. key: state_key of s; point: s projected.
    void update_one(Changes& changes, const Words4& key, const float* point, const float* action, double d) {
        uint32_t entry = slots[find_slot(key)];
        const bool stored = entry != no_entry;
        if (!stored) entry = insert(changes, key, point);
        count_access(entry);
        if (stored && e[entry] >= d) {
            ++changes.kept;
            return;
        }
        ++(stored ? changes.improved : changes.inserted);
        e[entry] = d;
        std::copy_n(action, A, &actions[entry * A]);
    }

    // A new entry for a state: the next one, or in a full table that which is evicted. Its a^e and e are left open.
    uint32_t insert(Changes& changes, const Words4& key, const float* point) {
        const bool full = size() == config.capacity;
        changes.evicted += full;
        const uint32_t entry = full ? evict() : static_cast<uint32_t>(size());
        if (!full)
            for_each_column(*this, [](auto, auto& column, size_t width) { column.resize(column.size() + width); });
        std::copy_n(key.data(), 4, &keys[size_t{entry} * 4]);
        std::copy_n(point, dim, &projected[entry * dim]);
        age[entry] = insertions++;
        priority[entry] = 0;
        slots[find_slot(key)] = entry;
        tree.insert(points(), entry);
        return entry;
    }

    // An access: an insertion, an exact hit in update(), a neighbour that passed epsilon in a look-up.
    void count_access(uint32_t entry) {
        ++accesses;
        priority[entry] = config.eviction == Eviction::lfu ? priority[entry] + 1 : accesses;
    }

    HeapItem heap_item(uint32_t entry) const { return {priority[entry], age[entry], entry}; }

    // WODTEM sec. IV-B.1, full table: "When Q is filled, we remove the least frequently accessed entry"; ties: the
    // oldest. Returns its number, which goes to the entry that is inserted next.
    // Accesses do not touch the heap: an item holds the priority that its entry had when it was pushed, and a priority
    // only grows. So when the smallest item is up to date, none is below it; else it goes back with its present
    // priority: amortised, one push per access. The item of the entry evicted last is still on top and goes back first.
    uint32_t evict() {
        for (uint32_t i = 0; heap.size() < size(); ++i) heap.push(heap_item(i));
        uint32_t entry = std::get<2>(heap.top());
        for (; heap.top() != heap_item(entry); entry = std::get<2>(heap.top())) {
            heap.pop();
            heap.push(heap_item(entry));
        }
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

    // Removal without tombstones: the entries of the run that follows are put in again.
    void empty_slot(size_t slot) {
        slots[slot] = no_entry;
        while (slots[slot = (slot + 1) & (slots.size() - 1)] != no_entry) {
            const uint32_t moved = std::exchange(slots[slot], no_entry);
            slots[find_slot(key_of(moved))] = moved;
        }
    }

    // ---- sec. IV-B.2: neighbours

    // [state_dim] -> [dim]. Accumulated in double, rounded once. Without projection: the state itself.
    void project(const float* state, float* point) const {
        check_column("state", std::span(state, S), 1, S);
        constexpr double largest = std::numeric_limits<float>::max();
        if (projection.empty()) std::copy_n(state, S, point);
        for (size_t row = 0; row * S < projection.size(); ++row) {
            double sum = 0.0;
            for (size_t i = 0; i < S; ++i) sum += projection[row * S + i] * state[i];
            point[row] = static_cast<float>(std::clamp(sum, -largest, largest));  // finite whatever the state
        }
        for (size_t d = 0; d < dim; ++d) point[d] += 0.0f;  // -0 becomes +0
    }

    // WODTEM sec. IV-B.2, K(s_q): {(s_k, a_k^e, e_k) : q(s_q, s_k) < epsilon, 1 <= k <= K}, closest first, for
    // projected s_q `at` [n, dim], each with an entry that is passed over, `skipped` [n]. limit: reach(), the largest
    // distance of a neighbour. Several walks take one step each in turn, so that the next node of a walk can come from
    // memory while the others compute. The K closest of those within epsilon are those within epsilon of the K closest.
    Neighbourhoods nearest(const std::vector<float>& at, const std::vector<uint32_t>& skipped, float limit) const {
        const size_t n = skipped.size(), K = static_cast<size_t>(config.K);
        Neighbourhoods found{K, std::vector<Neighbour>(n * K), std::vector<size_t>(n)};
        constexpr size_t most = 16;
        Walk walks[most];
        Walk::Subtree stacks[most][KdTree::longest_path];  // not initialised: most walks need little of them
        size_t begun = 0, active = 0;
        const auto next = [&](Walk::Subtree* stack) {
            const size_t i = begun++;
            return Walk{i, &at[i * dim], skipped[i], limit, stack};
        };
        for (; active < std::min(n, most); ++active) walks[active] = next(stacks[active]);
        const Points p = points();
        vectorised<float>([&](auto) INLINE_LAMBDA {
            while (active > 0)
                for (size_t i = active; i-- > 0;)
                    if (!walks[i].step(tree, p, found))
                        walks[i] = begun < n ? next(walks[i].subtrees) : walks[--active];
        });
        return found;
    }

    // The largest float below epsilon: distances are floats, so q <= reach() says q < epsilon.
    float reach() const {
        const float bound = static_cast<float>(std::min<double>(config.epsilon, std::numeric_limits<float>::max()));
        return bound < config.epsilon ? bound : std::nextafter(bound, -INFINITY);
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
        return nearest(at, skipped, reach());
    }

    void count_accesses(std::span<const Neighbour> found) {
        for (const Neighbour& neighbour : found) count_access(neighbour.entry);
    }

    // ---- eqs. (5) to (7). `found` is K(s_q).

    // exp(-q_k) / exp(-q_1), where q_1 is the smallest distance: the quotient in eq. (5) is the same, and no distance
    // can make it 0 / 0. The float exp is used, because the bits of libm's double exp depend on the processor.
    static double similarity(std::span<const Neighbour> found, size_t k) {
        return std::exp(found[0].distance - found[k].distance);
    }

    // WODTEM eq. (5): e-hat(s_q) = sum_k p_k e_k, p_k = exp(-q(s_q, s_k)) / sum_k1 exp(-q(s_q, s_k1)).
    // Returns whether d >= e-hat(s_q), that is whether a_c is "the historical optimal action", as
    // sum_k exp(-q_k) (e_k - d) <= 0: if all e_k equal d each term is 0, whereas a rounded mean of equal numbers can
    // exceed them. Without neighbours the sum is empty and the answer yes: nothing speaks against a_c.
    bool is_optimal(std::span<const Neighbour> found, double d) const {
        double excess = 0.0;
        for (size_t k = 0; k < found.size(); ++k) excess += similarity(found, k) * (e[found[k].entry] - d);
        return excess <= 0.0;
    }

    // WODTEM eq. (7): w(s, a) = 1 if d >= e-hat(s), else alpha. `optimal` is what is_optimal() returned.
    static double weight(bool optimal, double alpha) { return optimal ? 1.0 : alpha; }

    // WODTEM eq. (6): p(a_k^e | s_q, s_k, e_k) = exp(e_k / tau) / sum_k1 exp(e_k1 / tau); a-hat(s_q) is drawn from it.
    // The largest e is subtracted first: e reaches thousands and exp(89) overflows a float. `uniform` lies in [0, 1);
    // the neighbour is drawn by the inverse of the cumulative distribution. Returns the action [action_dim].
    // Errors: memory.no_neighbours for an empty K(s_q). No caller asks then: such a step has w = 1.
    const float* advised_action(std::span<const Neighbour> found, double uniform) const {
        if (found.empty()) fail("memory.no_neighbours", "no neighbour within epsilon: there is no action to advise");
        double best = e[found[0].entry], total = 0.0;
        for (const Neighbour& neighbour : found) best = std::max(best, e[neighbour.entry]);
        std::vector<double> cumulative;
        for (const Neighbour& neighbour : found) {
            total += double{std::exp(static_cast<float>((e[neighbour.entry] - best) / config.tau))};
            cumulative.push_back(total);
        }
        // uniform <= 1 - 2^-53 makes uniform * total < total even when rounded. So one neighbour is drawn, and never
        // one of probability 0, which leaves the sum unchanged.
        const auto drawn = std::upper_bound(cumulative.begin(), cumulative.end(), uniform * total);
        return &actions[found[drawn - cumulative.begin()].entry * A];
    }

    // ---- columns

    // Calls each(name, column, numbers per entry) for every column of the table.
    static void for_each_column(auto& self, const auto& each) {
        each("memory.keys", self.keys, size_t{4});
        each("memory.projected", self.projected, self.dim);
        each("memory.actions", self.actions, self.A);
        each("memory.e", self.e, size_t{1});
        each("memory.priority", self.priority, size_t{1});
        each("memory.age", self.age, size_t{1});
    }

    // Derives from the columns what is not stored in them. The columns must fit together and no key may repeat.
    void rebuild_derived() {
        std::vector<uint32_t> all(size());
        std::iota(all.begin(), all.end(), 0u);
        slots.assign(std::bit_ceil(config.capacity + config.capacity / 2 + 1), no_entry);  // load at most 2/3
        for (const uint32_t entry : all) slots[find_slot(key_of(entry))] = entry;
        heap = {};
        tree = {};
        tree.build_node(points(), 0, tree.take_pair(dim), all);
    }
};
