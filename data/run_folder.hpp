// run_folder.hpp: a run is a folder. What stands in it, and how a run that was interrupted continues:
//
//   settings                 the settings, each with its source (settings.hpp); written first
//   command                  the command that makes this run, with the paths of its data set and first weights
//   progress.csv             a row for each evaluation        grows
//   episodes.csv             a row for each online episode    grows
//   seconds.csv              when each evaluation was made    grows; no part of the state
//   checkpoint.safetensors   the whole state, while the run is unfinished
//   model.safetensors        the trained model (model_file.hpp)
//   policy.csv, start_actions.csv (grid world), paths.csv (mazes): what the report's figures need
//   finished                 empty; written last
//   kept.safetensors         with --keep-state: the state before the last evaluation, to go on with a larger budget
//   budgets                  the smaller budgets of a run that went on, a line each
//
// Promises: the checkpoint notes the length and the checksum of progress.csv and episodes.csv, and continuing cuts them
// back to it, so an interrupted run ends with the same bytes, but for seconds.csv; a folder of other settings is left
// as it is; one process at a time works in a folder. Leaves out: what the state of a run is (the caller visits it).
#pragma once

#include <sys/file.h>

#include <ctime>
#include <fstream>

#include "../gridworld.hpp"
#include "../mujoco_env.hpp"
#include "console.hpp"
#include "model_file.hpp"  // and with it safetensors.hpp, settings.hpp and the standard headers

// ---------------------------------------------------------------------------------------------------------------------
// Rows of the logs.

inline constexpr const char* progress_header =
    "phase,updates,interactions,episodes,learning_rate,loss,entropy,lambda,gradient_norm,short,unmatched,memory,"
    "eval_length,eval_return,eval_score,rollout_length,rollout_return,matched,evicted,dropped,"
    "advice,advice_distance,advice_shift,physics\n";
inline constexpr const char* held_out_header = "held_out_log_prob,held_out_error\n";  // further columns of own data
inline constexpr const char* episodes_header = "episode,interactions,length,return,terminated,actions,physics\n";

// Sums since the latest row of progress.csv.
struct Tally {
    double loss = 0, entropy = 0, gradient_norm = 0, updates = 0;
    double pairs = 0, short_pairs = 0, unmatched_pairs = 0;  // looked up; with d < e-hat; without a neighbour
    double matched = 0, evicted = 0;  // states that the table already held; entries that it gave up
    double rollout_length = 0, rollout_return = 0, rollouts = 0;
    double dropped = 0;  // episodes whose simulation broke down
    // The dose: what eq. (9) changes of eq. (2), as add_advice() sums it over updates. advice_shift [action_dim], or
    // [discrete_actions], is empty before the first advice; visit_state() saves it.
    double advice = 0, advice_distance = 0;
    std::vector<double> advice_shift = {};

    void visit(auto& archive) {
        archive("progress.loss", loss);
        archive("progress.entropy", entropy);
        archive("progress.gradient_norm", gradient_norm);
        archive("progress.summed_updates", updates);
        archive("progress.pairs", pairs);
        archive("progress.short_pairs", short_pairs);
        archive("progress.unmatched_pairs", unmatched_pairs);
        archive("progress.matched", matched);
        archive("progress.evicted", evicted);
        archive("progress.rollout_length", rollout_length);
        archive("progress.rollout_return", rollout_return);
        archive("progress.rollouts", rollouts);
        archive("progress.dropped", dropped);
        archive("progress.advice", advice);
        archive("progress.advice_distance", advice_distance);
    }
};

// How far a shift of an action goes: its Euclidean length; of a distribution over moves, the probability that is moved.
inline double length_of_shift(const std::vector<double>& shift, bool discrete) {
    double sum = 0;
    for (const double x : shift) sum += discrete ? std::fabs(x) / 2 : x * x;
    return discrete ? sum : std::sqrt(sum);
}

// Adds a step's share of the dose. Eq. (2) fits the policy to a, eq. (9) to w a + (1 - w) a-hat, where a discrete
// action is a distribution over the moves, all on one. advice: (1 - w) times the step's coefficient in the loss; its
// sum is the share of the loss that is advice. Beside it are summed the shift advice (a-hat - a), in which opposite
// shifts cancel, and the length of each step's shift. a, a_hat: [action_dim].
inline void add_advice(Tally& tally, const EnvironmentSpec& spec, double advice, const float* a, const float* a_hat) {
    tally.advice += advice;
    if (spec.discrete_actions > 0) {
        tally.advice_shift.resize(spec.discrete_actions);
        tally.advice_shift[static_cast<size_t>(*a_hat)] += advice;
        tally.advice_shift[static_cast<size_t>(*a)] -= advice;
        tally.advice_distance += *a_hat == *a ? 0 : advice;
        return;
    }
    tally.advice_shift.resize(spec.action_dim);
    double squares = 0;
    for (size_t j = 0; j < tally.advice_shift.size(); ++j) {
        const double shift = advice * (static_cast<double>(a_hat[j]) - static_cast<double>(a[j]));
        tally.advice_shift[j] += shift;
        squares += shift * shift;
    }
    tally.advice_distance += std::sqrt(squares);
}

struct ProgressRow {
    bool online;
    uint64_t updates, interactions, episodes;
    double learning_rate, lambda;  // lambda: NaN where the entropy is not constrained
    size_t memory_size;
    double eval_length, eval_return, eval_score;
    Tally tally;
    double held_out_log_prob = NAN, held_out_error = NAN;  // of own data
};

struct EpisodeRow {
    uint64_t episode, interactions;
    const Trajectory& trajectory;  // with its returns
    bool discrete;                 // the actions are moves of the grid world
};

// A line of a log: the fields as value_text() gives them.
inline std::string csv_line(const auto&... fields) {
    std::string line;
    ((line += value_text(fields) + ","), ...);
    line.back() = '\n';
    return line;
}

// The last column: which simulation the numbers belong to.
inline std::string physics_text(const Settings& settings) {
    if (settings.task == own_data) return "own data";
    return settings.task == "gridworld" ? "grid world" : settings.physics + " on MuJoCo " + settings.mujoco;
}

// ", normalised score 12.3" for the tasks that have one.
inline std::string score_text(const Settings& settings, double total_return) {
    const MujocoTask* task = find_mujoco_task(settings.task);
    return task ? ", normalised score " + number_text(static_cast<float>(normalised_score(*task, total_return))) : "";
}

inline std::string progress_line(const ProgressRow& row, const Settings& settings) {
    const Tally& t = row.tally;
    const auto mean = [](double sum, double count) {  // to seven digits
        return count > 0 ? static_cast<float>(sum / count) : NAN;
    };
    const bool has_entropy = settings.method != "dt";
    const double advised_updates = settings.method == "wodtem" ? t.updates : 0;
    const double shift = length_of_shift(t.advice_shift, spec_of(settings).discrete_actions > 0);
    std::string line =
        csv_line(row.online ? "online" : "offline", row.updates, row.interactions, row.episodes, row.learning_rate,
                 mean(t.loss, t.updates), mean(t.entropy, has_entropy ? t.updates : 0), static_cast<float>(row.lambda),
                 mean(t.gradient_norm, t.updates), mean(t.short_pairs, t.pairs), mean(t.unmatched_pairs, t.pairs),
                 row.memory_size, row.eval_length, row.eval_return, row.eval_score, mean(t.rollout_length, t.rollouts),
                 mean(t.rollout_return, t.rollouts), t.matched, t.evicted, t.dropped, mean(t.advice, advised_updates),
                 mean(t.advice_distance, advised_updates), mean(shift, advised_updates), physics_text(settings));
    if (settings.task != own_data) return line;
    line.back() = ',';
    return line + csv_line(static_cast<float>(row.held_out_log_prob), static_cast<float>(row.held_out_error));
}

inline std::string progress_header_of(const Settings& settings) {
    const std::string header = progress_header;
    return settings.task == own_data ? header.substr(0, header.size() - 1) + "," + held_out_header : header;
}

// What is said of a run whose folder holds a part of it already, and of a run that is finished.
inline void print_continuation(const std::string& path, bool resumed, uint64_t updates) {
    if (resumed)
        std::fprintf(stderr, "%s: continuing at update %s\n", path.c_str(), number_text(updates).c_str());
    else
        std::fprintf(stderr, "%s: no checkpoint, starting anew\n", path.c_str());
}

inline void print_end(const std::string& path, const ProgressRow& row, const Settings& settings) {
    std::printf("%s: %s updates, %s interactions, evaluation length %s, return %s%s\n", path.c_str(),
                number_text(row.updates).c_str(), number_text(row.interactions).c_str(),
                number_text(row.eval_length).c_str(), number_text(row.eval_return).c_str(),
                score_text(settings, row.eval_return).c_str());
}

// The command `eval`: each episode, on the grid world with its moves; then the means over those without an error, and
// the standard deviation of the returns over them.
inline void print_evaluation(const Settings& settings, const std::vector<Episode>& episodes, double mean_length,
                             double mean_return) {
    size_t number = 0;
    Moments returns;
    for (const Episode& episode : episodes) {
        ++number;
        if (!episode.error.empty()) {
            std::fprintf(stderr, "wodtem: episode %zu is dropped: %s\n", number, episode.error.c_str());
            continue;
        }
        const double total = total_return(episode.trajectory);
        returns.add(total);
        std::printf("episode %zu: length %d, return %s", number, episode.trajectory.length(),
                    number_text(static_cast<float>(total)).c_str());
        for (const float move : episode.trajectory.actions)
            if (settings.task == "gridworld") std::printf(" %s", grid_move_table[static_cast<size_t>(move)].name);
        std::printf("\n");
    }
    const std::string deviation =
        returns.count > 1 ? " +- " + number_text(static_cast<float>(returns.sample_deviation())) : "";
    std::printf("%s, %s, seed %lld: mean length %s, mean return %s%s%s over %.0f episode%s (%s)\n",
                settings.task.c_str(), settings.method.c_str(), static_cast<long long>(settings.seed),
                number_text(mean_length).c_str(), number_text(mean_return).c_str(), deviation.c_str(),
                score_text(settings, mean_return).c_str(), returns.count, returns.count == 1 ? "" : "s",
                physics_text(settings).c_str());
}

// The numbers that end a line of progress on the console.
inline std::string status_text(const ProgressRow& row, double updates_a_second) {
    const auto shown = [](const char* format, double x) {
        char text[60] = "";
        if (std::isfinite(x)) std::snprintf(text, sizeof text, format, x);
        return std::string(text);
    };
    const Tally& t = row.tally;
    const double updates = t.updates > 0 ? t.updates : NAN;
    return shown("update %.0f", static_cast<double>(row.updates)) +
           (row.online ? shown(", interaction %.0f", static_cast<double>(row.interactions)) : "") +
           shown(", loss %.3g", t.loss / updates) + shown(", evaluation: length %.4g", row.eval_length) +
           shown(", return %.3g", row.eval_return) + shown(", %.0f updates a second", updates_a_second);
}

inline std::string episode_line(const EpisodeRow& row, const Settings& settings) {
    std::string moves;  // a digit each
    if (row.discrete)
        for (const float action : row.trajectory.actions) moves += static_cast<char>('0' + static_cast<int>(action));
    return csv_line(row.episode, row.interactions, row.trajectory.length(), total_return(row.trajectory),
                    row.trajectory.terminated ? "1" : "0", moves, physics_text(settings));
}

// ---------------------------------------------------------------------------------------------------------------------
// The folder and its logs.

// A file that grows by lines. Length and checksum are part of the checkpoint.
struct Log {
    std::string path;
    uint64_t bytes = 0, crc = 0;

    void append(const std::string& line) {
        AppendFile(path).write(line);
        bytes += line.size();
        crc = crc32(line, static_cast<uint32_t>(crc));
    }
    void begin(const std::string& header) {
        write_file_atomic(path, "");
        bytes = crc = 0;
        append(header);
    }

    // Errors: run.log, if the file does not begin with what it held at the checkpoint.
    void check() const {
        const std::string text = std::filesystem::exists(path) ? read_file(path) : "";
        const bool same = text.size() >= bytes && crc32(std::string_view(text).substr(0, bytes)) == crc;
        require(same, "run.log", path, " is not what it was at the checkpoint (", bytes,
                " bytes); restore it, or remove the folder to start anew");
    }
};

// seconds.csv: a row for each evaluation, and one where a process begins or continues the run. Seconds count the time
// that was spent on the run, but for what an interrupted process did after its last row. date: UTC.
struct SecondsLog {
    std::string path, machine;  // machine: where this process works, without commas
    double before = 0;          // seconds of the processes that worked on the run before
    Clock::time_point began = Clock::now();

    // resumed: whether the run goes on, and its rows with it. A row that was cut off is dropped. Errors: run.seconds.
    void begin(bool resumed, uint64_t updates, uint64_t interactions) {
        std::string text = resumed && std::filesystem::exists(path) ? read_file(path) : "";
        text.resize(text.rfind('\n') + 1);
        const std::vector<std::string> lines = split(text, '\n');  // the last one is empty
        if (lines.size() < 3) {
            text = "updates,interactions,seconds,date,machine,program\n";
        } else {
            const std::vector<std::string> fields = split(lines[lines.size() - 2], ',');
            before = fields.size() == 6 ? to_number(fields[2]).value_or(-1) : -1;
            require(before >= 0 && before < 1e12, "run.seconds", path,
                    ": its last line has no seconds; remove the file, which only the report's durations come from");
        }
        write_file_atomic(path, text);
        began = Clock::now();
        write_row(updates, interactions, before);
    }
    void append(uint64_t updates, uint64_t interactions) const {
        write_row(updates, interactions, before + seconds_since(began));
    }
    void write_row(uint64_t updates, uint64_t interactions, double elapsed) const {
        const std::time_t now = std::time(nullptr);
        char seconds[32], date[32];
        std::snprintf(seconds, sizeof seconds, "%.3f", elapsed);
        std::strftime(date, sizeof date, "%Y-%m-%dT%H:%M:%SZ", std::gmtime(&now));
        AppendFile(path).write(csv_line(updates, interactions, seconds, date, machine, program_text()));
    }
};

// "Intel Xeon; kernel avx512 fp32; threads 2"; no commas.
inline std::string machine_text(const Kernel& kernel, int threads) {
    std::string processor = "unknown processor";
    std::ifstream file("/proc/cpuinfo");
    for (std::string line; std::getline(file, line);)
        if (line.starts_with("model name") && line.find(": ") != std::string::npos)
            processor = line.substr(line.find(": ") + 2);
    std::erase(processor, ',');
    return processor + "; kernel " + kernel.name + " " + kernel.precision() + "; threads " + std::to_string(threads);
}

struct RunFolder {
    std::string path;
    Log progress{file("progress.csv")}, episodes{file("episodes.csv")};

    std::string file(const char* name) const { return path + "/" + name; }
    bool has(const char* name) const { return std::filesystem::exists(file(name)); }

    void begin_logs(const Settings& settings) {
        progress.begin(progress_header_of(settings));
        episodes.begin(episodes_header);
    }
    void sync_logs() const {
        AppendFile(progress.path).sync();
        AppendFile(episodes.path).sync();
    }
    void visit(auto& archive) {
        archive("progress.progress_bytes", progress.bytes);
        archive("progress.episodes_bytes", episodes.bytes);
        archive("progress.progress_crc", progress.crc);
        archive("progress.episodes_crc", episodes.crc);
    }
};

// Returns whether the folder was not there. Errors: `id`.
inline bool make_folder(const std::string& path, const char* id) {
    std::error_code problem;
    const bool made = std::filesystem::create_directories(path, problem);
    require(!problem, id, "cannot make the folder ", path, ": ", problem.message());
    return made;
}

// Errors: run.folder.
inline void rename_file(const std::string& from, const std::string& to) {
    std::error_code problem;
    std::filesystem::rename(from, to, problem);
    require(!problem, "run.folder", "cannot rename ", from, " to ", to, ": ", problem.message());
}

// A file that is not there is none to remove. Errors: run.folder.
inline void remove_file(const std::string& path) {
    std::error_code problem;
    std::filesystem::remove(path, problem);
    require(!problem, "run.folder", "cannot remove ", path, ": ", problem.message());
}

// Makes a folder, if it is not there, and keeps other processes out of it for as long as this lives; the system
// releases the lock however the process ends. A folder that it made and that stayed empty, after a refused start, goes
// again. Errors: run.busy, run.folder. A file system that has no locks is reported on stderr, and the run goes on.
struct FolderLock : File {
    bool made;

    explicit FolderLock(const std::string& name) : FolderLock(name, make_folder(name, "run.folder")) {}
    FolderLock(const std::string& name, bool is_new)
        : File(name, O_RDONLY | O_DIRECTORY, "run.folder", "open the run folder"),
          made(is_new) {
        if (::flock(fd, LOCK_EX | LOCK_NB) == 0) return;
        require(errno != EWOULDBLOCK, "run.busy", "another process is training in ", path,
                "; wait for it, or choose another folder with --out");
        std::fprintf(stderr, "wodtem: %s cannot be locked (%s); make sure that no other process works in it\n",
                     path.c_str(), std::strerror(errno));
    }
    ~FolderLock() {
        if (made) ::rmdir(path.c_str());  // which leaves what holds a file
    }
};

// A run that was stopped, or that kept its state, goes on with larger budgets: its state becomes a checkpoint. Its
// model stays until the run is finished again. Errors: run.not_kept, run.folder.
inline void go_on(const RunFolder& folder, const Settings& begun, const Settings& settings) {
    const bool kept = folder.has("kept.safetensors"), has_state = kept || folder.has("checkpoint.safetensors");
    require(has_state || !folder.has("finished"), "run.not_kept", folder.path,
            " is finished and has not kept its state; train with --keep-state to go on with a larger budget later");
    remove_file(folder.file("finished"));
    if (kept) rename_file(folder.file("kept.safetensors"), folder.file("checkpoint.safetensors"));
    const std::string line =
        text_of("offline_updates = ", begun.offline_updates, ", online_steps = ", begun.online_steps, "\n");
    const std::string path = folder.file("budgets"), before = folder.has("budgets") ? read_file(path) : "";
    if (!before.ends_with(line)) write_file_atomic(path, before + line);
    write_file_atomic(folder.file("settings"), settings_text(settings));
}

// A folder, which must be locked, may be new, hold this very run, perhaps with smaller budgets, or hold another run or
// files of the user's, which are then left as they are. Errors: run.folder, run.other_settings, run.not_kept, and those
// of settings_from_text() if what is called settings is not a run's.
inline void claim_folder(const RunFolder& folder, const Settings& settings) {
    remove_temporaries(folder.path);
    const bool has_run = folder.has("progress.csv") || folder.has("checkpoint.safetensors") || folder.has("finished");
    require(folder.has("settings") || !(has_run || folder.has("command")), "run.folder", folder.path,
            " holds files of a run without its settings file; choose another folder with --out");
    if (!folder.has("settings")) return;
    const std::string path = folder.file("settings");
    const Settings begun = settings_from_text(read_file(path, 1 << 20), path);
    if (!has_run) return;  // a run was killed before its first row, and another may begin
    const Settings larger = with_larger_budgets(begun, settings);
    require_same_settings(larger, settings, folder.path);
    if (larger.online_steps != begun.online_steps || larger.offline_updates != begun.offline_updates)
        go_on(folder, begun, settings);
}

// Writes what a run is, once its data have been read: a start that is refused leaves nothing.
inline void describe_run(const RunFolder& folder, const Settings& settings) {
    if (!folder.has("progress.csv") && !folder.has("checkpoint.safetensors"))
        write_file_atomic(folder.file("settings"), settings_text(settings));
    write_file_atomic(folder.file("command"), train_command(settings) + "\n");
}

// ---------------------------------------------------------------------------------------------------------------------
// The checkpoint. visit(archive) calls archive(name, field) for everything that is state.

// The logs reach the disk first: the checkpoint notes how long they are.
inline void save_checkpoint(RunFolder& folder, const Settings& settings, auto&& visit) {
    folder.sync_logs();
    TensorFile file;
    file.metadata["format"] = checkpoint_format;
    file.metadata["settings"] = settings_text(settings);
    Saver saver{file};
    folder.visit(saver);
    visit(saver);
    write_safetensors(folder.file("checkpoint.safetensors"), file);
}

// Reads the state alone. Errors name the file: checkpoint.format, run.other_settings, safetensors.*, and those of the
// visited state.
inline void load_state(RunFolder& folder, const Settings& settings, auto&& visit) {
    const std::string path = folder.file("checkpoint.safetensors");
    try {
        const TensorFile file = read_own_safetensors(path);
        const bool checkpoint = file.text("format") == checkpoint_format;
        require(checkpoint, "checkpoint.format", "it is no checkpoint of this version of `wodtem train`");
        const Settings begun = settings_from_text(file.text("settings"), path);
        require_same_settings(with_larger_budgets(begun, settings), settings, path);
        Loader loader{file};
        folder.visit(loader);
        visit(loader);
    } catch (const Error& error) {
        throw Error(error.id, path + " cannot be used: " + error.what() + "; remove it to start this run anew");
    }
}

// Reads the state and cuts the logs back to where they were; if one of them does not fit, neither is touched.
inline void load_checkpoint(RunFolder& folder, const Settings& settings, auto&& visit) {
    load_state(folder, settings, visit);
    folder.progress.check();
    folder.episodes.check();
    truncate_file(folder.progress.path, folder.progress.bytes);
    truncate_file(folder.episodes.path, folder.episodes.bytes);
}

// Decides when a checkpoint is due: every so many seconds, but so that saving takes at most a twentieth of the time.
struct CheckpointTimer {
    double every;  // seconds; 0: always due
    Clock::time_point saved = Clock::now();
    double save_seconds = 0;  // of the latest one

    bool due() const { return every == 0 || seconds_since(saved) >= std::max(every, 20 * save_seconds); }
    void time(auto&& save) {
        const Clock::time_point begin = Clock::now();
        save();
        save_seconds = seconds_since(begin);
        saved = Clock::now();
    }
};

// Of a finished run: the checkpoint goes, or becomes the state from which the run can go on.
inline void retire_checkpoint(const RunFolder& folder, bool keep) {
    if (!folder.has("checkpoint.safetensors")) return;
    if (keep)
        rename_file(folder.file("checkpoint.safetensors"), folder.file("kept.safetensors"));
    else
        remove_file(folder.file("checkpoint.safetensors"));
}

// Says so if the run is finished, and retires a checkpoint that a kill has left beside the model.
inline bool is_finished_already(const RunFolder& folder, bool keep) {
    if (!folder.has("finished")) return false;
    retire_checkpoint(folder, keep);
    std::printf("%s is finished already\n", folder.path.c_str());
    return true;
}

// ---------------------------------------------------------------------------------------------------------------------
// What the figures need.

// policy.csv: the learned probability of each move in each cell. probabilities [36][8].
inline void save_policy(const RunFolder& folder, const std::vector<std::vector<float>>& probabilities) {
    std::string text = "row,column";
    for (const GridMove& move : grid_move_table) text += std::string(",") + move.name;
    text += "\n";
    for (int cell = 0; cell < grid_cells; ++cell) {
        text += std::to_string(cell / grid_size) + "," + std::to_string(cell % grid_size);
        for (const float p : probabilities[cell]) text += "," + number_text(p);
        text += "\n";
    }
    write_file_atomic(folder.file("policy.csv"), text);
}

// The share of each move among those made at S; [8].
inline std::vector<double> moves_at_start(const std::vector<Trajectory>& trajectories, GridWorld world) {
    std::vector<float> start(world.spec().state_dim);
    world.cell = grid_start;
    world.observe(start.data());
    std::vector<double> shares(grid_moves);
    double visits = 0;
    for (const Trajectory& trajectory : trajectories) {
        for (size_t t = 0; t < trajectory.actions.size(); ++t) {
            const float* state = &trajectory.states[t * start.size()];
            if (!std::equal(start.begin(), start.end(), state)) continue;
            shares[static_cast<size_t>(trajectory.actions[t])] += 1;
            visits += 1;
        }
    }
    for (double& share : shares) share /= std::max(1.0, visits);
    return shares;
}

// start_actions.csv: shares of the moves made at S by the policy, in the data set and in D_online; [8] each, `online`
// empty for a run without an online phase.
inline void save_start_actions(const RunFolder& folder, const std::vector<float>& learned,
                               const std::vector<double>& offline, const std::vector<double>& online) {
    std::string text = "move,learned,offline,online\n";
    for (int move = 0; move < grid_moves; ++move)
        text += csv_line(grid_move_table[move].name, learned[move], offline[move], online.empty() ? NAN : online[move]);
    write_file_atomic(folder.file("start_actions.csv"), text);
}

// paths.csv: the positions of an evaluation's episodes in a maze, the last state included; nothing for other tasks.
// environments [episodes]: those that played them.
inline void save_maze_paths([[maybe_unused]] const RunFolder& folder,
                            [[maybe_unused]] const std::vector<Episode>& episodes,
                            [[maybe_unused]] std::span<Environment* const> environments) {
#ifdef WODTEM_MUJOCO
    std::vector<std::array<double, 2>> goals;
    for (const Environment* environment : environments) {
        const auto* body = dynamic_cast<const MujocoEnvironment*>(environment);
        if (!body || !body->task->maze) return;
        goals.push_back(body->goal);
    }
    std::string text = "episode,step,goal_x,goal_y,x,y\n";
    size_t number = 0;
    for (size_t i = 0; i < episodes.size(); ++i) {
        const Episode& episode = episodes[i];
        if (!episode.error.empty()) continue;
        const size_t length = episode.trajectory.rewards.size(), state_dim = episode.state.size();
        for (size_t t = 0; t <= length; ++t) {
            const float* state = t < length ? &episode.trajectory.states[t * state_dim] : episode.state.data();
            text += csv_line(number, t, goals[i][0], goals[i][1], state[0], state[1]);
        }
        ++number;
    }
    write_file_atomic(folder.file("paths.csv"), text);
#endif
}
