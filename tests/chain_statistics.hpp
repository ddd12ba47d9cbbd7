// chain_statistics.hpp: exact statistics of the grid world's behaviour policy, for `check` and the tests.
#pragma once

#include "../gridworld.hpp"

struct ChainStatistics {
    double mean_length, sd_length;  // steps per trajectory
    double mean_return, sd_return;  // reward per trajectory: the share that reaches G within the limit
};

// Under the behaviour policy an episode is a Markov chain on the 36 cells. With p_t the distribution over cells after t
// steps (p_0: all at S; p_t = p_0 times the t-th power of the transition matrix, G absorbing) and s_t = 1 - p_t[G] the
// probability that G is not reached within t steps, the length l of a trajectory, cut at 100, has
//   E[l] = sum of s_t over t < 100,   E[l^2] = sum of (2t + 1) s_t over t < 100,   E[return] = p_100[G].
// The means are in gridworld.hpp, above Behaviour.
inline ChainStatistics chain_statistics(Behaviour behaviour, EdgeRule edge) {
    std::array<double, grid_cells> p{};  // p_t
    p[grid_start] = 1;
    double mean = 0, mean_square = 0;
    for (int t = 0; t < grid_max_steps; ++t) {
        mean += 1 - p[grid_goal];
        mean_square += (2 * t + 1) * (1 - p[grid_goal]);
        std::array<double, grid_cells> next{};  // p_(t+1)
        next[grid_goal] = p[grid_goal];
        for (int cell = 0; cell < grid_goal; ++cell) {
            const auto weights = behaviour_weights(behaviour, edge, cell);
            for (int move = 0; move < grid_moves; ++move)
                next[next_cell(edge, cell, move)] += p[cell] * weights[move] / weight_sum(weights);
        }
        p = next;
    }
    const double success = p[grid_goal];  // the return is 0 or 1, so its variance is success (1 - success)
    return {mean, std::sqrt(mean_square - mean * mean), success, std::sqrt(success * (1 - success))};
}
