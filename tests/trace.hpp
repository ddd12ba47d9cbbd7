// trace.hpp: the command `trace`: steps a MuJoCo task from given states through given actions and prints every number
// to 17 digits, for whoever compares another implementation of a task with this one.
#pragma once

#include <cmath>
#include <cstdio>
#include <iostream>
#include <string>
#include <vector>

#include "../data/settings.hpp"
#include "../mujoco_env.hpp"

inline std::string trace_help() {
    return "\nStandard input, line by line:\n"
           "  init qpos,...   with the next line starts a segment: mj_resetData, write both, mj_forward\n"
           "  init qvel,...   answered by one line: init obs,...\n"
           "  goal,X,Y        mazes: the goal from here on, in observed coordinates\n"
           "  ...,...         an action as a policy gives it; answered by one line: obs...,reward,done\n"
           "Nothing ends an episode but the next init.\n";
}

#ifdef WODTEM_MUJOCO

// A line of the input.
struct TraceLine {
    size_t number;
    std::string text;

    [[noreturn]] void refuse(const std::string& expected) const {
        fail("trace.line", "line %zu of the input is \"%s\"; expected %s", number,
             text.size() > 60 ? (text.substr(0, 60) + "...").c_str() : text.c_str(), expected.c_str());
    }

    // The `count` numbers after `keyword`. Errors: trace.line says what is `expected`.
    std::vector<double> numbers(const std::string& keyword, int count, const std::string& expected) const {
        if (!text.starts_with(keyword)) refuse(expected);
        const std::vector<double> values =
            numbers_between_commas(text.substr(keyword.size()), [&](const std::string&) { refuse(expected); });
        if (values.size() != static_cast<size_t>(count)) refuse(expected);
        return values;
    }
};

inline void print_numbers(std::string line, const std::vector<double>& values) {
    for (const double value : values) {
        char text[40];
        std::snprintf(text, sizeof text, "%.17g", value);
        line += (line.empty() ? "" : ",") + std::string(text);
    }
    std::printf("%s\n", line.c_str());
}

inline void print_step(MujocoEnvironment& environment, const std::vector<double>& action) {
    const Step step = environment.advance(action);
    std::vector<double> row = environment.observation;
    row.push_back(step.reward);
    row.push_back(step.terminated ? 1 : 0);
    print_numbers("", row);
}

// Answers the lines of `input` as trace_help() says. Errors: trace.line, environment.*.
inline void trace(MujocoEnvironment& environment, std::istream& input) {
    const mjModel& model = *environment.model;
    const int action_dim = environment.task->action_dim;
    const std::string finite = " finite numbers, separated by commas";
    const std::string an_init = "init qpos, and " + std::to_string(model.nq) + finite,
                      a_velocity = "init qvel, and " + std::to_string(model.nv) + finite,
                      a_goal = "goal, and 2" + finite,
                      an_action = "an action, " + std::to_string(action_dim) + finite + ", or " + an_init;
    std::vector<double> qpos;  // of an init whose second line has not come yet
    bool started = false;
    TraceLine line{0, ""};
    while (std::getline(input, line.text)) {
        ++line.number;
        if (line.text.ends_with('\r')) line.text.pop_back();  // Windows ends lines so
        if (line.text.starts_with("goal")) {
            if (!environment.task->maze) line.refuse("no goal: " + std::string(environment.task->name) + " is no maze");
            const std::vector<double> goal = line.numbers("goal,", 2, a_goal);
            environment.goal = {goal[0], goal[1]};
        } else if (!qpos.empty()) {
            environment.start(qpos, line.numbers("init qvel,", model.nv, a_velocity));
            print_numbers("init obs", environment.observation);
            qpos.clear();
            started = true;
        } else if (line.text.starts_with("init")) {
            qpos = line.numbers("init qpos,", model.nq, an_init);
        } else {
            if (!started) line.refuse(an_init);
            print_step(environment, line.numbers("", action_dim, an_action));
        }
    }
    line.text.clear();
    ++line.number;
    if (!qpos.empty()) line.refuse(a_velocity);
}

#endif

// The command `trace`. physics: d4rl or 2.2, "" for the task's own. Errors: usage.*, mujoco.absent, and those of
// trace().
inline void trace_task(const std::string& task, const std::string& physics) {
    Settings settings = default_settings(task, "wodtem", "paper");
    if (!physics.empty()) set_setting(settings, "physics", physics);
    check_together(settings);
    if (settings.task == "gridworld") fail("usage.task", "trace steps the MuJoCo tasks; gridworld is a table of moves");
#ifdef WODTEM_MUJOCO
    std::setvbuf(stdout, nullptr, _IOLBF, 0);  // another program may be waiting for each answer
    std::fprintf(stderr, "%s, %s on MuJoCo %s\n", settings.task.c_str(), settings.physics.c_str(),
                 mujoco_version().c_str());
    MujocoEnvironment environment(*find_mujoco_task(settings.task),
                                  static_cast<Physics>(index_of(physics_names, settings.physics)));
    trace(environment, std::cin);
#else
    fail("mujoco.absent", "%s needs MuJoCo 2.2, which was not there when this program was built; %s",
         settings.task.c_str(), mujoco_advice);
#endif
}
