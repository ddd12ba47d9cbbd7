// test_gridworld.cpp: the grid world against dynamic programming, the behaviour policy against its Markov chain, and
// the default data set against the statistics that WODTEM sec. IV-A prints.
#include <limits>
#include <string>

#include "chain_statistics.hpp"
#include "test.hpp"

namespace {

constexpr EdgeRule edge_rules[] = {EdgeRule::clipped, EdgeRule::stays, EdgeRule::wraps, EdgeRule::excluded};
constexpr Behaviour behaviours[] = {Behaviour::right_down, Behaviour::left_down};

// The rules told a second way, from the letters of a move's name: first one coordinate, then the other.
int walk_by_letters(EdgeRule edge, int cell, const std::string& name) {
    int row = cell / 6, column = cell % 6;
    bool bumped = false;
    for (char letter : name) {
        int* coordinate = letter == 'U' || letter == 'D' ? &row : &column;
        const bool forward = letter == 'R' || letter == 'D';
        const int wall = forward ? 5 : 0;
        if (letter == '-') continue;
        if (*coordinate != wall)
            *coordinate += forward ? 1 : -1;
        else if (edge == EdgeRule::wraps)
            *coordinate = 5 - wall;
        else
            bumped = true;
    }
    return bumped && edge != EdgeRule::clipped ? cell : row * 6 + column;
}

// Steps to G from every cell [36], by sweeps of d(cell) = 1 + min over moves of d(next cell) until nothing changes.
std::array<int, grid_cells> shortest_paths(EdgeRule edge) {
    std::array<int, grid_cells> distance;
    distance.fill(1000);
    distance[grid_goal] = 0;
    for (bool changed = true; changed;) {
        changed = false;
        for (int cell = 0; cell < grid_cells; ++cell) {
            for (int move = 0; move < grid_moves; ++move) {
                const int through = 1 + distance[next_cell(edge, cell, move)];
                if (through >= distance[cell]) continue;
                distance[cell] = through;
                changed = true;
            }
        }
    }
    return distance;
}

double mean_length(const std::vector<Trajectory>& data_set) {
    double steps = 0;
    for (const Trajectory& trajectory : data_set) steps += trajectory.length();
    return steps / static_cast<double>(data_set.size());
}

double mean_return(const std::vector<Trajectory>& data_set) {
    double sum = 0;
    for (const Trajectory& trajectory : data_set)
        for (float reward : trajectory.rewards) sum += reward;
    return sum / static_cast<double>(data_set.size());
}

// Behaviour::right_down and EdgeRule::clipped, the defaults; drawn once for all tests.
const std::vector<Trajectory>& default_data_set() {
    static const auto data_set = collect_data_set(GridWorld{}, Behaviour::right_down, default_data_seed);
    return data_set;
}

}  // namespace

// WODTEM sec. IV-A test
TEST(the_eight_moves_are_named_in_the_order_of_the_paper) {
    const char* names[] = {"R", "D", "L", "U", "R-D", "R-U", "L-D", "L-U"};
    for (int move = 0; move < grid_moves; ++move) CHECK_EQUAL(std::string(grid_move_table[move].name), names[move]);
}

TEST(every_move_from_every_cell_follows_the_edge_rule) {
    for (EdgeRule edge : edge_rules)
        for (int cell = 0; cell < grid_cells; ++cell)
            for (int move = 0; move < grid_moves; ++move)
                CHECK_EQUAL(next_cell(edge, cell, move), walk_by_letters(edge, cell, grid_move_table[move].name));
}

TEST(a_diagonal_into_a_wall_does_what_the_edge_rule_says) {
    const int cell = 2 * 6 + 0, left_down = 6;  // (2, 0), at the left wall
    CHECK_EQUAL(next_cell(EdgeRule::clipped, cell, left_down), 3 * 6 + 0);
    CHECK_EQUAL(next_cell(EdgeRule::stays, cell, left_down), cell);
    CHECK_EQUAL(next_cell(EdgeRule::wraps, cell, left_down), 3 * 6 + 5);
    CHECK_EQUAL(next_cell(EdgeRule::excluded, cell, left_down), cell);
}

TEST(only_arriving_at_the_goal_pays_and_terminates) {
    for (int cell = 0; cell < grid_goal; ++cell) {
        for (int move = 0; move < grid_moves; ++move) {
            GridWorld world;
            world.cell = cell;
            const float action = static_cast<float>(move);
            float state[grid_cells];  // room for either encoding
            const Step step = world.step(&action, state);
            const bool arrived = state[0] == 5 && state[1] == 5;
            CHECK_EQUAL(step.reward, arrived ? 1.0 : 0.0);
            CHECK_EQUAL(step.terminated, arrived);
        }
    }
}

TEST(step_refuses_what_is_not_a_move) {
    GridWorld world;
    float state[grid_cells];  // room for either encoding
    for (float action : {-1.0f, 8.0f, 0.5f, std::numeric_limits<float>::quiet_NaN()})
        CHECK_FAILS("gridworld.bad_action", world.step(&action, state));
    world.cell = grid_goal;
    const float right = 0;
    CHECK_FAILS("gridworld.episode_over", world.step(&right, state));
    world.reset(Random{0, Stream::environment}, 0, state);
    CHECK(world.cell == grid_start && state[0] == 0 && state[1] == 0);
}

// WODTEM sec. IV-A test: "the optimal trajectory of the agent, which has a length of 5"
TEST(the_shortest_path_has_five_steps_and_one_on_the_torus) {
    for (EdgeRule edge : edge_rules) CHECK_EQUAL(shortest_paths(edge)[grid_start], edge == EdgeRule::wraps ? 1 : 5);
    const auto distance = shortest_paths(EdgeRule::clipped);
    for (int cell = 0; cell < grid_cells; ++cell) CHECK_EQUAL(distance[cell], 5 - std::min(cell / 6, cell % 6));
}

// WODTEM sec. V-D test: gamma is 0.99. Value iteration through step(): V(cell) = max over moves of r + gamma V(next).
TEST(the_optimal_discounted_return_of_a_cell_is_gamma_to_the_steps_before_the_last) {
    constexpr double gamma = 0.99;
    std::array<double, grid_cells> value{};
    for (int sweep = 0; sweep < grid_cells; ++sweep) {
        for (int cell = 0; cell < grid_goal; ++cell) {
            for (int move = 0; move < grid_moves; ++move) {
                GridWorld world;
                world.cell = cell;
                const float action = static_cast<float>(move);
                float state[grid_cells];
                const Step step = world.step(&action, state);
                value[cell] = std::max(value[cell], step.reward + gamma * value[world.cell]);
            }
        }
    }
    const auto distance = shortest_paths(EdgeRule::clipped);
    for (int cell = 0; cell < grid_goal; ++cell) {
        double expected = 1;
        for (int steps = 1; steps < distance[cell]; ++steps) expected *= gamma;
        CHECK_CLOSE(value[cell], expected, 1e-12);
    }
}

TEST(one_hot_and_coordinates_name_the_same_cells) {
    const GridWorld world(EdgeRule::clipped, StateEncoding::one_hot);
    const auto one_hot = collect_data_set(world, Behaviour::right_down, default_data_seed, 20);
    for (size_t i = 0; i < one_hot.size(); ++i) {
        const Trajectory& coordinates = default_data_set()[i];
        CHECK(one_hot[i].actions == coordinates.actions);
        std::vector<float> expected(one_hot[i].states.size(), 0.0f);  // [T, 36]
        for (int t = 0; t < coordinates.length(); ++t)
            expected[t * 36 + static_cast<int>(coordinates.states[2 * t] * 6 + coordinates.states[2 * t + 1])] = 1;
        CHECK(one_hot[i].states == expected);
    }
    CHECK_EQUAL(GridWorld{}.spec().state_dim, 2);
    CHECK_EQUAL(world.spec().state_dim, 36);
}

// WODTEM sec. IV-A test: 20% to two moves, 10% to each of the others
TEST(the_behaviour_policy_has_the_stated_probabilities) {
    using Weights = std::array<int, grid_moves>;
    CHECK(behaviour_weights(Behaviour::right_down, EdgeRule::clipped, 0) == (Weights{2, 2, 1, 1, 1, 1, 1, 1}));
    CHECK(behaviour_weights(Behaviour::left_down, EdgeRule::stays, 0) == (Weights{1, 2, 2, 1, 1, 1, 1, 1}));
    // At S only right, down and right-down stay on the grid.
    CHECK(behaviour_weights(Behaviour::left_down, EdgeRule::excluded, 0) == (Weights{1, 2, 0, 0, 1, 0, 0, 0}));
}

// WODTEM sec. IV-A test: no reading of "left" and "down" agrees with 47.50 and 0.91
TEST(the_markov_chain_gives_the_statistics_of_every_reading) {
    const struct {
        Behaviour behaviour;
        EdgeRule edge;
        double length, mean_return;
    } readings[] = {
        {Behaviour::left_down, EdgeRule::stays, 85.08, 0.335},
        {Behaviour::left_down, EdgeRule::clipped, 78.81, 0.455},
        {Behaviour::left_down, EdgeRule::excluded, 78.44, 0.452},
        {Behaviour::left_down, EdgeRule::wraps, 33.36, 0.924},
        {Behaviour::right_down, EdgeRule::stays, 54.89, 0.840},
        {Behaviour::right_down, EdgeRule::clipped, 49.81, 0.884},
        {Behaviour::right_down, EdgeRule::excluded, 45.38, 0.914},
        {Behaviour::right_down, EdgeRule::wraps, 35.37, 0.919},
    };
    for (const auto& reading : readings) {
        const ChainStatistics chain = chain_statistics(reading.behaviour, reading.edge);
        CHECK_CLOSE(chain.mean_length, reading.length, 0.005);
        CHECK_CLOSE(chain.mean_return, reading.mean_return, 0.0005);
        // How far the paper's data set is from this reading, in standard deviations of a mean over 500 trajectories.
        const double length_off = std::fabs(chain.mean_length - 47.50) * std::sqrt(500.0) / chain.sd_length;
        const double return_off = std::fabs(chain.mean_return - 0.91) * std::sqrt(500.0) / chain.sd_return;
        const bool agrees = reading.behaviour == Behaviour::right_down &&
                            (reading.edge == EdgeRule::clipped || reading.edge == EdgeRule::excluded);
        CHECK_EQUAL(std::max(length_off, return_off) < 2, agrees);
        if (!agrees) CHECK(length_off > 5);
        if (reading.behaviour == Behaviour::left_down) CHECK(length_off > 8);
    }
    const ChainStatistics defaults = chain_statistics(Behaviour::right_down, EdgeRule::clipped);
    CHECK_CLOSE(defaults.sd_length / std::sqrt(500.0), 1.255, 0.0005);
    CHECK_CLOSE(defaults.sd_return / std::sqrt(500.0), 0.0143, 0.00005);
}

TEST(sampled_data_sets_agree_with_the_markov_chain) {
    constexpr int count = 20000;
    for (Behaviour behaviour : behaviours) {
        for (EdgeRule edge : edge_rules) {
            const auto data_set = collect_data_set(GridWorld(edge), behaviour, test_seed(), count);
            const ChainStatistics chain = chain_statistics(behaviour, edge);
            CHECK_CLOSE(mean_length(data_set), chain.mean_length, 4 * chain.sd_length / std::sqrt(count));
            CHECK_CLOSE(mean_return(data_set), chain.mean_return, 4 * chain.sd_return / std::sqrt(count));
            double square = 0;  // the spread too: of 20000 lengths it is good to about half a per cent
            for (const Trajectory& trajectory : data_set) {
                const double off = trajectory.length() - chain.mean_length;
                square += off * off;
            }
            CHECK_CLOSE(std::sqrt(square / count) / chain.sd_length, 1, 0.03);
        }
    }
}

// WODTEM sec. IV-A test: 500 trajectories, mean length 47.50, mean return 0.91
TEST(the_default_data_set_has_the_statistics_of_the_paper) {
    CHECK_EQUAL(default_data_set().size(), size_t{500});
    CHECK_EQUAL(mean_length(default_data_set()), 47.5);
    CHECK_EQUAL(mean_return(default_data_set()), 0.91);
}

TEST(every_trajectory_replays_step_by_step) {
    for (const Trajectory& trajectory : default_data_set()) {
        GridWorld world;
        float state[grid_cells];  // room for either encoding
        world.reset(Random{0, Stream::environment}, 0, state);
        Step step{};
        for (int t = 0; t < trajectory.length(); ++t) {
            CHECK(!step.terminated);
            CHECK(trajectory.states[2 * t] == state[0] && trajectory.states[2 * t + 1] == state[1]);
            step = world.step(&trajectory.actions[t], state);
            CHECK_EQUAL(static_cast<double>(trajectory.rewards[t]), step.reward);
        }
        CHECK_EQUAL(trajectory.terminated, step.terminated);
        CHECK(trajectory.terminated ? trajectory.length() <= 100 : trajectory.length() == 100);
    }
}

TEST(another_seed_gives_another_data_set_and_the_same_seed_the_same) {
    const auto again = collect_data_set(GridWorld{}, Behaviour::right_down, default_data_seed, 3);
    const auto other = collect_data_set(GridWorld{}, Behaviour::right_down, default_data_seed + 1, 3);
    for (size_t i = 0; i < 3; ++i) CHECK(again[i].actions == default_data_set()[i].actions);
    CHECK(other[0].actions != again[0].actions);
}
