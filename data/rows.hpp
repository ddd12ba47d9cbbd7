// rows.hpp: the rows of a data set in D4RL's layout while it is made. D4RL's families have different arrays of the same
// names; an array that a family does not have stays empty.
// Leaves out: files (collect.hpp writes them, d4rl.hpp reads them); how rows come about.
#pragma once

#include <cstdint>
#include <vector>

// Appends the elements of a range, converted to the vector's type.
template <class To, class From>
void append_all(std::vector<To>& to, const From& from) {
    for (const auto x : from) to.push_back(static_cast<To>(x));
}

// N rows; T: float, and double in the gym tasks' replay sets, as in D4RL's files.
template <class T>
struct CollectedRows {
    std::vector<T> observations, next_observations;  // [N, S]; the second of gym tasks only
    std::vector<T> actions, rewards;                 // [N, A], [N]
    std::vector<uint8_t> terminals;                  // [N] 0 or 1
    std::vector<T> numeric_terminals;                // [N] the same as numbers, in place of the flags: antmaze only
    std::vector<uint8_t> timeouts;                   // [N] 0 or 1
    std::vector<T> goal;                             // [N, 2] mazes only: the target of the row
    std::vector<T> log_probs;                        // [N] of the actions: gym tasks' medium sets only
    std::vector<T> qpos, qvel;                       // [N, nq], [N, nv]

    size_t length() const { return timeouts.size(); }

    // Calls f(name, array, is_table) for each array in the order of D4RL's files: its name there, a pointer to the
    // member, and whether it has two dimensions.
    static void each_array(auto&& f) {
        f("observations", &CollectedRows::observations, true);
        f("next_observations", &CollectedRows::next_observations, true);
        f("actions", &CollectedRows::actions, true);
        f("rewards", &CollectedRows::rewards, false);
        f("terminals", &CollectedRows::terminals, false);
        f("terminals", &CollectedRows::numeric_terminals, false);
        f("timeouts", &CollectedRows::timeouts, false);
        f("infos/goal", &CollectedRows::goal, true);
        f("infos/action_log_probs", &CollectedRows::log_probs, false);
        f("infos/qpos", &CollectedRows::qpos, true);
        f("infos/qvel", &CollectedRows::qvel, true);
    }

    void append(const CollectedRows& more) {
        each_array([&](const char*, auto array, bool) { append_all(this->*array, more.*array); });
    }
};
