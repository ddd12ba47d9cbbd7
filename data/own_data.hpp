// own_data.hpp: data of no task of this program, and states from outside: training on a file alone, and the command
// `act`. Included by wodtem.cpp behind the phases, whose functions it calls.
//
// Without an environment nothing can be evaluated by acting. What is measured instead, on trajectories that are held
// out: how likely the policy finds their actions, and how far its own actions are from them.
#pragma once

#include <fstream>
#include <iostream>

// ---------------------------------------------------------------------------------------------------------------------
// Training on a file.

// Means over the steps of the trajectories; NaN where there are none. log_prob: log pi(a_t | s, g) with the
// returns-to-go that the trajectory had, for DT minus its loss. error: the share of moves that are not the policy's
// most likely one; for continuous actions the squared error of the policy's mean, averaged over the dimensions.
struct HeldOut {
    double log_prob = NAN, error = NAN;
};

// How far an action of the policy is from one of the data; both [action_dim].
double action_error(const Agent& agent, const std::vector<float>& action, const float* recorded) {
    if (agent.discrete()) return action[0] == *recorded ? 0 : 1;
    double squares = 0;
    for (size_t j = 0; j < action.size(); ++j) squares += std::pow(double{action[j]} - double{recorded[j]}, 2);
    return squares / static_cast<double>(action.size());
}

// Measures windows of at most context_length steps, one behind the other, as many at a time as a part of an update has.
// acting: a tape that does not record.
HeldOut measure(const Agent& agent, Tape<float>& acting, const std::vector<Trajectory>& trajectories) {
    const FrozenWeights frozen(acting.compute);
    const int context = static_cast<int>(agent.settings.context_length);
    double log_probs = 0, errors = 0, steps = 0;
    std::vector<Window> windows;
    int waiting = 0;  // steps of `windows`
    const auto measure_windows = [&] {
        acting.reset();
        const Batch batch = batch_of(agent, trajectories, windows);
        const Policy<float> policy = forward(acting, agent.model, batch.sequences, Queries::every_state);
        const Tensor<float> log_p = log_prob(acting, policy, batch.actions.data());
        for (int i = 0; i < log_p.rows; ++i) {
            const std::vector<float> action = choose_action(agent, policy, i, Act::greedy, Random{}, 0, 0);
            log_probs += log_p.value[i];
            errors += action_error(agent, action, &batch.actions[i * agent.spec.action_dim]);
            steps += 1;
        }
        windows.clear();
        waiting = 0;
    };
    for (size_t trajectory = 0; trajectory < trajectories.size(); ++trajectory)
        for (int start = 0, T = trajectories[trajectory].length(); start < T; start += context) {
            windows.push_back({trajectory, start, std::min(context, T - start)});
            waiting += windows.back().length;
            if (waiting >= 2048 / 3) measure_windows();
        }
    if (waiting > 0) measure_windows();
    return steps > 0 ? HeldOut{log_probs / steps, errors / steps} : HeldOut{};
}

void print_held_out(const Run& run, const std::string& path, const HeldOut& held_out, size_t trajectories) {
    const std::string updates = number_text(run.progress.updates);
    if (trajectories == 0)
        return void(std::printf("%s: %s updates; no trajectory is held out, so nothing is measured\n", path.c_str(),
                                updates.c_str()));
    const bool likelihood = run.agent.model.config.head != Head::deterministic;
    std::printf("%s: %s updates; trajectories held out: %zu; %s %s, %s %s\n", path.c_str(), updates.c_str(),
                trajectories, likelihood ? "log-probability of an action" : "minus the loss",
                number_text(static_cast<float>(held_out.log_prob)).c_str(),
                run.agent.discrete() ? "share of other moves" : "squared error of the mean",
                number_text(static_cast<float>(held_out.error)).c_str());
}

// The offline phase on own data. Measures before the first update, and after each tenth of all updates; as in the other
// phases, what is left to do follows from the state alone: progress.evaluations is the number of rows that were due at
// the latest one, under the present budget.
void fit_own_data(Run& run, const Observer& observer, const std::string& path) {
    const std::vector<Trajectory> held_out = part_of_own_data(run.agent.settings, true);
    Progress& p = run.progress;
    const uint64_t updates = static_cast<uint64_t>(run.agent.settings.offline_updates);
    const uint64_t every = std::max<uint64_t>(1, (updates + 9) / 10);
    HeldOut measured;
    while (true) {
        const bool last = p.updates >= updates;
        const uint64_t due = 1 + p.updates / every + (last && updates % every != 0);
        if (last) observer.ending();
        if (p.evaluations != due || last) {
            measured = measure(run.agent, run.acting, held_out);
            ProgressRow row = progress_row(run);
            row.held_out_log_prob = measured.log_prob;
            row.held_out_error = measured.error;
            observer.evaluated(row, {});
            p.evaluations = due;
            run.tally = {};
        }
        if (last) break;
        update(run);
        observer.pause(static_cast<double>(p.updates) / static_cast<double>(updates));
    }
    print_held_out(run, path, measured, held_out.size());
}

// ---------------------------------------------------------------------------------------------------------------------
// The command `act`.

// An agent that acts: from a model or checkpoint alone, without memory or buffer.
struct Actor {
    const TensorFile file;
    const Settings settings;
    Agent agent;
    ModelContents contents;
    Compute compute;
    Tape<float> acting;

    explicit Actor(const Arguments& arguments)
        : file(open_model_or_checkpoint(arguments.words[0])),
          settings(evaluated_settings(arguments, file)),
          agent(settings, spec_of(settings)),
          contents(contents_of(agent)),
          compute(kernel_of(arguments), thread_count(arguments)),
          acting(compute) {
        load_model(contents, file);
        acting.recording = false;
    }
};

inline std::string act_help() {
    return "\nInput, line by line, from FILE or standard input; each line is answered by one line:\n"
           "  STATE            its numbers as the environment gives them, separated by commas\n"
           "  RETURN,STATE     the same behind the return that is still wanted, in units of the reward\n"
           "  (a blank line)   the next line begins another episode; not answered\n"
           "Without RETURN it stays what it was; at first it is the setting g_eval. An answer is the most likely\n"
           "action, its numbers separated by commas; a move is its number, from 0. The latest states of an episode\n"
           "and the actions that were answered are the context.\n";
}

// The numbers of a line. Errors: act.line.
std::vector<double> numbers_of_line(const std::string& line, size_t number, size_t state_dim) {
    std::vector<double> values = numbers_between_commas(line, [&](const std::string& part) {
        throw Error("act.line",
                    text_of("line ", number, " of the input: \"", part.substr(0, 40), "\" is not a finite number"));
    });
    require(values.size() == state_dim || values.size() == state_dim + 1, "act.line", "line ", number,
            " of the input has ", values.size(), " numbers; expected the ", state_dim,
            " of a state, or the return that is wanted and these");
    return values;
}

// The action for an episode's present state; the episode goes on by it. Nothing if the policy has no finite answer.
// acting: a tape that does not record.
std::vector<float> act(const Agent& agent, Tape<float>& acting, Episode& episode) {
    acting.reset();
    Episode* const one[] = {&episode};
    const Policy<float> policy = forward(acting, agent.model, acting_batch(agent, one), Queries::last_state);
    for (int i = 0; i < policy.output.columns; ++i)
        if (!std::isfinite(policy.output.value[i])) return {};
    const std::vector<float> action = choose_action(agent, policy, 0, Act::greedy, Random{}, 0, 0);
    append_all(episode.trajectory.states, episode.state);
    append_all(episode.trajectory.actions, action);
    episode.trajectory.rewards.push_back(0);  // not known; the length counts
    return action;
}

// Answers each line of the file, or of standard input if the name is empty, at once: another program may be waiting.
// Ends when nobody reads the answers any more. Errors: act.line, act.not_finite, file.read.
void act_on_lines(const Agent& agent, Tape<float>& acting, const std::string& path) {
    const FrozenWeights frozen(acting.compute);
    std::ifstream file;
    if (!path.empty()) file.open(path);
    require(!file.fail(), "file.read", "cannot open ", path, ": ", std::strerror(errno));
    std::istream& input = path.empty() ? std::cin : file;
    const size_t state_dim = agent.spec.state_dim;
    Episode episode;
    std::string line;
    size_t number = 0;
    while (!std::ferror(stdout) && std::getline(input, line)) {
        ++number;
        if (line.ends_with('\r')) line.pop_back();
        if (number == 1 && line.starts_with("\xEF\xBB\xBF")) line.erase(0, 3);  // some editors begin a file so
        if (trimmed(line).empty()) {
            episode = {};
            continue;
        }
        const std::vector<double> values = numbers_of_line(line, number, state_dim);
        episode.state.assign(values.end() - static_cast<ptrdiff_t>(state_dim), values.end());
        if (values.size() > state_dim)
            episode.targets.push_back(static_cast<float>(values[0] * agent.settings.reward_scale));
        else  // the reward is not known: what is wanted stays
            append_target(episode, agent.settings.g_eval, agent.settings.reward_scale);
        const std::vector<float> action = act(agent, acting, episode);
        require(!action.empty(), "act.not_finite", "line ", number,
                " of the input: the policy has no finite answer; are state and return in the data's units?");
        std::string answer;
        for (const float one : action) answer += number_text(one) + ",";
        answer.back() = '\n';
        std::printf("%s", answer.c_str());
        std::fflush(stdout);
    }
    const bool failed = input.bad() || (path.empty() && std::ferror(stdin) != 0);  // cin takes the latter for an end
    require(!failed, "file.read", "cannot read ", path.empty() ? "standard input" : path, " beyond line ", number);
}
