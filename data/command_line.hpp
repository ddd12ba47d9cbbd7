// command_line.hpp: `wodtem COMMAND WORDS... --option value...`: options, their parsing, help, and the settings that a
// command line describes. The table of commands itself, which names the functions, stands in wodtem.cpp.
//
// Promises: results go to stdout, progress and errors to stderr; bad usage is a sentence that names the nearest right
// word, and exit status 2; other failures exit with 1.
#pragma once

#include <poll.h>
#include <unistd.h>

#include <csignal>
#include <fstream>

#include "d4rl.hpp"
#include "model_file.hpp"
#include "settings.hpp"

// ---------------------------------------------------------------------------------------------------------------------
// Commands and options.

struct Option {
    const char *commands, *name;     // commands: that take it, separated by blanks
    const char* value;               // placeholder of what follows it, or null for a switch
    const char *fallback, *meaning;  // fallback: its value where it is not given
};

inline const Option option_table[] = {
    {"train import tasks", "--method", "NAME", "wodtem", "dt, odt or wodtem"},
    {"train", "--methods", "LIST", "", "several methods, separated by commas, one after the other"},
    {"train import sweep tasks", "--preset", "NAME", "small",
     "paper: Tables I and II as printed; small: less of it; reduced: Table II's schedule with a small network"},
    {"train", "--seed", "N", "0", "seed of everything but the data set"},
    {"train", "--seeds", "A-B", "", "several seeds, one after the other"},
    {"train import sweep", "--set", "NAME=VALUE", "", "any setting (see `wodtem tasks TASK`); may be repeated"},
    {"train import trace", "--physics", "NAME", "",
     "bodies: d4rl (the default), as in MuJoCo up to 2.1.0; 2.2, as that computes them"},
    {"train import sweep check", "--dataset", "FILE", "",
     "HDF5 in D4RL's or Minari's layout, or Minari's folder (default: by the task's name); random: none"},
    {"train import sweep", "--clip-actions", nullptr, "",
     "clip the data set's actions to [-1, 1], not refuse those beyond"},
    {"train", "--weights", "MODEL", "",
     "begin with a model's network, temperature and normaliser, not with random ones"},
    {"train", "--out", "DIR", "", "the run's folder (default: runs/TASK-PRESET-METHOD-SEED)"},
    {"train", "--checkpoint-every", "SECONDS", "30", "how much work a kill may cost; 0: save after each update"},
    {"train", "--keep-state", nullptr, "",
     "so that a finished run can go on with more online_steps or offline_updates"},
    {"eval", "--episodes", "N", "", "episodes (default: as many as the run's evaluations have)"},
    {"eval", "--seed", "N", "", "of the starts (default: the starts of the run's last evaluation)"},
    {"eval act", "--set", "NAME=VALUE", "", "g_eval or eval_context; may be repeated"},
    {"eval", "--record", "FILE", "", "write the episodes there, as a data set in D4RL's layout"},
    {"export", "--odt", nullptr, "",
     "for load_state_dict(strict=True) of ODT's own code: its names, its unused tensors"},
    {"import", "--task", "ID", "", "whose network it is; not needed if `wodtem export` made the file"},
    {"collect", "--out", "FILE", "", "where to write (default: runs/datasets under D4RL's file name)"},
    {"collect", "--steps", "N", "", "rows (default: as many as D4RL's)"},
    {"collect", "--policy", "FILE", "", "of a medium or antmaze set (default: the one that this program holds)"},
    {"collect", "--seed", "N", "0", "of all that is drawn"},
    {"report", "--out", "DIR", "runs/report", "where to write"},
    {"sweep", "--methods", "LIST", "dt,odt,wodtem", "methods, separated by commas"},
    {"sweep", "--seeds", "A-B", "0-4", "seeds"},
    {"sweep", "--estimate", nullptr, "", "say how long the runs would take, as comments"},
    {"info", "--task", "ID", "", "of a data set whose name does not tell"},
    {"check", "-v", nullptr, "", "print inputs, the file's values and the program's"},
    {"check", "--dump", "FILE", "", "write every tensor of one update of a run instead, as a case of topic step"},
    {"check", "--run", "DIR", "", "of this run: its next update if it has a checkpoint, else its first; dropout off"},
    {"train eval act import sweep bench check", "--kernel", "NAME", "auto",
     "of matrix products: avx512 or avx2 (arithmetic fused), portable (plain); auto: the best there is"},
    {"train eval act import sweep check", "--precision", "NAME", "fp32",
     "of matrix products: fp32, or bf16, whose sums stay fp32 (avx512, on request portable)"},
    {"train eval act collect bench check", "--threads", "N", "0",
     "worker threads; 0: one per core, in train one alone for a small network; results do not depend on it"},
    {"bench", "--json", nullptr, "", "of updates: print one JSON array"},
};

struct Arguments {
    std::vector<std::string> words;              // that are not options
    std::map<std::string, std::string> options;  // all that the command takes; "yes" or "" for a switch
    std::set<std::string> given;                 // those on the command line
    std::vector<std::string> assignments;        // of --set, in order
    const std::string& operator[](const char* name) const { return options.at(name); }
    bool has(const char* name) const { return given.contains(name); }
};

struct Command {
    const char *name, *words;  // words: how its arguments look in the help
    size_t least_words, most_words;
    const char* meaning;
    void (*run)(const Arguments&);
    std::string (*notes)() = nullptr;  // what its help says below the options
};

inline std::vector<Option> options_of(const Command& command) {
    std::vector<Option> options(std::begin(option_table), std::end(option_table));
    std::erase_if(options, [&](const Option& option) { return !contains(split(option.commands, ' '), command.name); });
    return options;
}

// ---------------------------------------------------------------------------------------------------------------------
// Parsing and help.

// Errors: usage.option, which names the nearest option of the command; usage.words.
inline Arguments parse_arguments(const Command& command, const std::vector<std::string>& words) {
    const std::vector<Option> taken = options_of(command);
    Arguments arguments;
    for (const Option& option : taken) arguments.options[option.name] = option.fallback;
    for (size_t i = 0; i < words.size(); ++i) {
        if (!words[i].starts_with("-") || words[i].size() < 2) {
            arguments.words.push_back(words[i]);
            continue;
        }
        if (taken.empty())
            fail("usage.option", "wodtem %s has no options; \"%s\" was given", command.name, words[i].c_str());
        // Two words, or one: --name=value.
        const size_t equals = words[i].starts_with("--") ? words[i].find('=') : std::string::npos;
        const Option& option = row_named(
            taken, words[i].substr(0, equals), "usage.option",
            std::string("wodtem ") + command.name + " has no option \"%s\"%s (wodtem " + command.name + " --help)" +
                (arguments.options.contains("--set") ? "; a setting is given by --set, as --set learning_rate=1e-3"
                                                     : ""));
        const bool in_one = equals != std::string::npos;
        if (in_one && !option.value) fail("usage.option", "option %s takes no value", option.name);
        if (option.value && !in_one && (i + 1 == words.size() || words[i + 1].starts_with("--")))
            fail("usage.option", "option %s needs a value: %s", option.name, option.value);
        const std::string value = !option.value ? "yes" : in_one ? words[i].substr(equals + 1) : words[++i];
        if (value.empty())
            fail("usage.option", "option %s needs a value that is not empty: %s", option.name, option.value);
        const bool is_set = std::string_view(option.name) == "--set";  // it may be repeated, as switches may
        if (!arguments.given.insert(option.name).second && option.value && !is_set)
            fail("usage.option", "option %s is given twice", option.name);
        if (is_set) arguments.assignments.push_back(value);
        arguments.options[option.name] = value;
    }
    if (arguments.words.size() < command.least_words || arguments.words.size() > command.most_words)
        fail("usage.words", "wodtem %s takes %s; %zu argument%s given (wodtem %s --help)", command.name,
             *command.words ? command.words : "no argument", arguments.words.size(),
             arguments.words.size() == 1 ? " was" : "s were", command.name);
    return arguments;
}

inline void print_command_list(std::span<const Command> commands) {
    std::printf(
        "wodtem: decision transformers that go from offline data to online interaction, with an episodic memory\n\n");
    for (const Command& command : commands)
        std::printf("  wodtem %-7s %-12s %s\n", command.name, command.words, command.meaning);
    std::printf("\nwodtem COMMAND --help lists a command's options. Try: wodtem train gridworld --method wodtem\n");
}

// Which sources this program is of, which files it reads and writes, and with what it was built.
inline void print_version() {
    std::printf("wodtem: %s; %s; MuJoCo %s\n", model_format, program_text().c_str(), mujoco_version().c_str());
}

inline void print_help(const Command& command) {
    std::printf("wodtem %s %s\n%s\n\n", command.name, command.words, command.meaning);
    for (const Option& option : options_of(command)) {
        const std::string left = std::string(option.name) + " " + (option.value ? option.value : "");
        std::printf("  %-26s %s%s%s\n", left.c_str(), option.meaning, *option.fallback ? "; default " : "",
                    option.fallback);
    }
    if (command.notes) std::printf("%s", command.notes().c_str());
}

// Returns the exit status. Errors: usage.command, console.write, and those of the command.
inline int run_command_line(std::span<const Command> commands, const std::vector<std::string>& words) {
    const auto asks_for_help = [](const std::string& word) {
        return word == "--help" || word == "-h" || word == "help";
    };
    if (std::ranges::all_of(words, asks_for_help)) {
        print_command_list(commands);
    } else if (words[0] == "--version" && words.size() == 1) {
        print_version();
    } else {
        std::vector<std::string> rest = words;
        if (asks_for_help(words[0])) std::swap(rest[0], rest[1]);  // help train
        const Command& command =
            row_named(commands, rest[0], "usage.command", "unknown command \"%s\"%s (wodtem --help lists all)");
        rest.erase(rest.begin());
        if (std::any_of(rest.begin(), rest.end(), asks_for_help))
            print_help(command);
        else
            command.run(parse_arguments(command, rest));
    }
    const bool failed = std::fflush(stdout) != 0 || std::ferror(stdout);
    pollfd output = {STDOUT_FILENO, POLLOUT, 0};
    const bool reader_left = poll(&output, 1, 0) > 0 && (output.revents & POLLERR) != 0;  // as `head`: no failure
    if (failed && !reader_left) fail("console.write", "cannot write the results to stdout: is the disk full?");
    return words.empty() ? 2 : 0;
}

// The body of main(): every error becomes a sentence on stderr and an exit status.
inline int run_program(std::span<const Command> commands, std::span<const char* const> words) {
    std::signal(SIGPIPE, SIG_IGN);  // write() then returns an error, which becomes a sentence
    std::signal(SIGXFSZ, SIG_IGN);  // the same for a limit on file sizes
    try {
        return run_command_line(commands, {words.begin(), words.end()});
    } catch (const std::bad_alloc&) {
        std::fprintf(stderr, "wodtem: out of memory\n");
        return 1;
    } catch (const std::exception& error) {
        std::fprintf(stderr, "wodtem: %s\n", error.what());
        const auto* known = dynamic_cast<const Error*>(&error);
        return known && known->id.starts_with("usage.") ? 2 : 1;
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// Values.

// Errors: usage.number.
inline int64_t whole_number(const std::string& text, const char* name, int64_t low, int64_t high) {
    return static_cast<int64_t>(number_in(text, "usage.number", name, low, high, true));
}

// "3", "0-4" or "1,3,8". Errors: usage.number.
inline std::vector<int64_t> seed_list(const std::string& text) {
    std::vector<int64_t> seeds;
    for (const std::string& range : split(text, ',')) {
        const size_t dash = range.find('-', 1);
        const auto seed_of = [](const std::string& number) { return whole_number(number, "a seed", 0, 4294967295); };
        const int64_t first = seed_of(range.substr(0, dash));
        const int64_t last = dash == std::string::npos ? first : seed_of(range.substr(dash + 1));
        if (last < first || last - first > 9999)
            fail("usage.number", "the seeds \"%s\" are not a range such as 0-4", range.c_str());
        for (int64_t seed = first; seed <= last; ++seed) {
            if (contains(seeds, seed))
                fail("usage.number", "seed %lld is given twice in \"%s\"", static_cast<long long>(seed), text.c_str());
            seeds.push_back(seed);
        }
    }
    return seeds;
}

// Of two options that exclude each other, "one" and "several of it", the list of values.
inline const std::string& one_or_several(const Arguments& arguments, const char* one, const char* several) {
    if (arguments.has(one) && arguments.has(several))
        fail("usage.option", "%s and %s were both given; choose one", one, several);
    return arguments[arguments.has(several) ? several : one];
}

// The processors that this process may use: those of its affinity mask, or fewer where a container limits its share of
// time (Linux: cpu.max holds "QUOTA PERIOD", or "max PERIOD").
inline int processor_count() {
    const int processors = static_cast<int>(std::max(1u, std::thread::hardware_concurrency()));
    std::ifstream limits("/sys/fs/cgroup/cpu.max");
    double quota = 0, period = 0;
    if (!(limits >> quota >> period) || !(quota > 0 && period > 0)) return processors;
    return std::clamp(static_cast<int>(std::ceil(quota / period)), 1, processors);
}

inline int thread_count(const Arguments& arguments) {
    const int64_t asked = whole_number(arguments["--threads"], "--threads", 0, 256);
    return asked > 0 ? static_cast<int>(asked) : processor_count();
}

// Threads that a run uses where none are named: one if an update takes about a millisecond or less. Threads would then
// wait for each other more than they compute, and for whole time slices on a busy machine.
inline int default_threads(const Settings& settings) {
    const double weights = 12.0 * static_cast<double>(settings.layers * settings.width * settings.width);
    const double products = weights * static_cast<double>(settings.batch_size * (3 * settings.context_length - 1));
    return products < 1e7 ? 1 : processor_count();
}

// The kernel of --kernel and --precision. "auto" never chooses the imitation of bf16 in portable code. Errors:
// usage.kernel names the kernels of this machine.
inline const Kernel& kernel_of(const Arguments& arguments) {
    const std::string &name = arguments["--kernel"],  // bench measures both precisions and takes no --precision
        precision = arguments.options.contains("--precision") ? arguments["--precision"] : "fp32";
    std::string available;
    for (const Kernel* kernel : kernels) {
        if (!kernel->supported()) continue;
        const bool chosen = name == kernel->name || (name == "auto" && kernel != &kernel_portable_bf16);
        if (chosen && precision == kernel->precision()) return *kernel;
        available += std::string(available.empty() ? "" : ", ") + kernel->name + " " + kernel->precision();
    }
    fail("usage.kernel",
         "this machine has no kernel \"%s\" for precision \"%s\"; it has: %s. Choose with --kernel and --precision "
         "(portable bf16 is an imitation, and slow)",
         name.c_str(), precision.c_str(), available.c_str());
}

// The best kernel that gives the bits of a run's setting `arithmetic`. Errors: usage.kernel.
inline const Kernel& kernel_for(const std::string& arithmetic) {
    for (const Kernel* kernel : kernels)
        if (kernel->supported() && arithmetic == kernel->arithmetic()) return *kernel;
    fail("usage.kernel", "this machine has no kernel of arithmetic %s", arithmetic.c_str());
}

// ---------------------------------------------------------------------------------------------------------------------
// Settings from the command line.

// The data set's file for these settings. before, here and below: settings of the same command and file, if there are
// any, so that the file is not read again.
inline void take_file(Settings& settings, const std::string& path, const Settings* before) {
    settings.dataset_path = path;
    settings.dataset = data_set_name(path);
    settings.dataset_sha256 = before ? before->dataset_sha256 : sha256_of_file(path);
}

// Where the data set of settings that a file holds lies now. whose: that file. Errors: dataset.other.
inline void find_data_again(Settings& settings, const std::string& path, const std::string& whose) {
    settings.dataset_path = path;
    if (sha256_of_file(path) != settings.dataset_sha256)
        fail("dataset.other", "%s is not the data set of %s: its SHA-256 is not %s", path.c_str(), whose.c_str(),
             settings.dataset_sha256.c_str());
}

// given: a file; "random": none, so ten episodes of random actions and the online phase alone; "": the file of the
// task's id. Errors: dataset.missing, also where no data set has that name; those of data_set_file().
inline void choose_data_set(Settings& settings, const std::string& given, const Settings* before) {
    const PublishedDataSet* published = find_published(settings.task);
    if (given.empty() && !published)
        fail("dataset.missing",
             "%s is no data set's name: name one (wodtem tasks lists them), give a file with --dataset, or say "
             "--dataset random, which begins with ten episodes of random actions and has no offline phase",
             settings.task.c_str());
    if (given == "random") {
        set_from(settings, "behaviour", "random", "chosen: there is no data set");
        if (settings.method != "dt")
            set_from(settings, "offline_updates", "0", "there is no data set: the online phase alone");
        return;
    }
    take_file(settings, given.empty() ? find_data_set(*published) : data_set_file(given), before);
    const bool original = published && settings.dataset_sha256 == published->sha256;
    settings.source["dataset"] = original ? "D4RL's published file" : "not known as a published file";
}

// What own data decide by themselves: sizes, the entropy's bound, and what a return is compared with. Errors: those of
// data_set_file() and load_own_data().
inline void choose_own_data(Settings& settings, const std::string& given, const Settings* before = nullptr) {
    take_file(settings, data_set_file(given), before);
    settings.source["dataset"] = "own data";
    settings.own =
        before ? before->own : std::make_shared<OwnData>(load_own_data(settings.dataset_path, settings.clip_actions));
    const OwnData& data = *settings.own;
    double best = -INFINITY, largest = 0;  // of the returns; of their absolute values
    for (const Trajectory& trajectory : data.trajectories) {
        const double total = returns_to_go(trajectory.rewards).front();
        best = std::max(best, total);
        largest = std::max(largest, std::fabs(total));
    }
    const auto set = [&](const char* name, double value, const char* source) {
        set_from(settings, name, number_text(value), source);
    };
    set("state_dim", data.spec.state_dim, "the data set");
    set("action_dim", data.spec.action_dim, "the data set");
    set("moves", data.spec.discrete_actions, "the data set: 0 where actions are continuous");
    set("eta", -data.spec.action_dim, "ODT's code: minus the action dimensions");
    set("g_eval", std::clamp(best, -many, many), "chosen: the highest return in the data set");
    set("g_online", std::clamp(best, -many, many), "not used: there is no environment");
    if (largest > 0)
        set("reward_scale", std::clamp(std::pow(10.0, -std::floor(std::log10(largest))), 1e-9, 1e9),
            "chosen: a power of ten, so that the largest absolute return is from 1 to 10");
}

// Settings that options or what they name decide.
constexpr std::string_view not_for_set[] = {"task",       "method",  "preset",         "seed",          "arithmetic",
                                            "mujoco",     "dataset", "dataset_sha256", "first_weights", "state_dim",
                                            "action_dim", "moves",   "clip_actions"};

// NAME=VALUE of each --set. Errors: usage.setting.
inline void apply_assignments(Settings& settings, const std::vector<std::string>& assignments) {
    std::set<std::string> seen;
    for (const std::string& assignment : assignments) {
        const size_t equals = assignment.find('=');
        if (equals == std::string::npos)
            fail("usage.setting", "--set needs NAME=VALUE, not \"%s\"", assignment.c_str());
        const std::string name = setting_row(assignment.substr(0, equals)).name;
        if (contains(not_for_set, name))
            fail("usage.setting", "%s is not given by --set; see wodtem train --help", name.c_str());
        if (!seen.insert(name).second) fail("usage.setting", "setting %s is given twice", name.c_str());
        set_from(settings, name, assignment.substr(equals + 1), "command line");
    }
}

// Whether what stands in a task's place is the path of own data: by its ending, or because it is there.
inline bool is_data_file(const std::string& task) {
    const std::filesystem::path path = task;
    const bool named = path.extension() == ".hdf5" || path.extension() == ".h5";
    const bool is_task = contains(split(task_names, '|'), full_task_name(task));
    return !is_task && (named || is_there(task));
}

// What a task, or the path of own data in its place, makes the settings before --set. Errors: usage.*, and for own data
// those of load_own_data().
inline Settings chosen_settings(const Arguments& arguments, const std::string& task, const std::string& method,
                                const Settings* before = nullptr) {
    const bool own = is_data_file(task);
    if (own && arguments.has("--dataset"))
        fail("usage.option", "two data sets are given; to train on one of them for a task, name the task first");
    Settings settings = default_settings(own ? own_data : task, method, arguments["--preset"]);
    if (arguments.has("--clip-actions")) set_from(settings, "clip_actions", "yes", "command line");
    if (own) choose_own_data(settings, task, before);
    return settings;
}

// The settings of one run but for its seed, for the options that train and import share. Errors: usage.*,
// dataset.missing.
inline Settings settings_of(const Arguments& arguments, const std::string& task, const std::string& method,
                            const Settings* before = nullptr) {
    Settings settings = chosen_settings(arguments, task, method, before);
    if (find_mujoco_task(settings.task)) {
        settings.mujoco = mujoco_version();
        choose_data_set(settings, arguments["--dataset"], before);
    } else if (arguments.has("--dataset")) {
        fail("usage.option", "%s; leave --dataset out",
             settings.task == own_data ? "the file of own data stands in the task's place, as in wodtem train FILE.hdf5"
                                       : "the grid world makes its own data set");
    }
    if (arguments.has("--physics")) set_from(settings, "physics", arguments["--physics"], "command line");
    apply_assignments(settings, arguments.assignments);
    check_together(settings);
    settings.arithmetic = kernel_of(arguments).arithmetic();
    return settings;
}

// Sees, before an evaluation, whether a file can be written there that replaces neither the model nor the data set of
// its run. Errors: file.input, file.write, those of written_path().
inline void require_place_of_record(const std::string& record, const std::string& model, const Settings& settings) {
    require_other_file(record, model);
    std::error_code none;
    require(std::filesystem::is_directory(std::filesystem::absolute(record).parent_path(), none), "file.write", record,
            ": its folder does not exist; make it first");
    if (settings.dataset_sha256 != "none" && is_there(record))
        require(sha256_of_file(record) != settings.dataset_sha256, "file.input", record, ": is the data set that ",
                model, " learned from; give another path to write to");
}

// The settings of a model with what `eval` was told to change. Errors: usage.*.
inline Settings evaluated_settings(const Arguments& arguments, const TensorFile& file) {
    Settings settings = settings_in(file);
    if (arguments.has("--record")) require_place_of_record(arguments["--record"], file.path, settings);
    if (find_mujoco_task(settings.task))
        settings.mujoco = mujoco_version();  // of the library that steps the bodies here
    if (arguments.has("--episodes"))
        settings.eval_episodes = whole_number(arguments["--episodes"], "--episodes", 1, 10000);
    if (arguments.has("--seed")) settings.seed = whole_number(arguments["--seed"], "--seed", 0, 4294967295);
    for (const std::string& assignment : arguments.assignments)
        if (!assignment.starts_with("g_eval=") && !assignment.starts_with("eval_context="))
            fail("usage.setting",
                 "eval and act take --set g_eval=X and --set eval_context=N; \"%s\" is the model's own",
                 assignment.c_str());
    apply_assignments(settings, arguments.assignments);
    return settings;
}

// Of a network to import: with --task those of the command line; else those in the file, for which --dataset alone may
// be given. Errors: usage.*, settings.*, dataset.other; those of data_set_file().
inline Settings imported_settings(const Arguments& arguments, const TensorFile& file) {
    if (arguments.has("--task")) return settings_of(arguments, arguments["--task"], arguments["--method"]);
    if (!file.metadata.contains("settings"))
        fail("usage.option", "%s does not tell its settings; give --task, and --method, --preset, --set as in train",
             file.path.c_str());
    Settings settings = settings_in(file);
    for (const std::string& option : arguments.given)
        if (option != "--dataset" || settings.dataset_sha256 == "none")
            fail("usage.option",
                 "%s holds its own settings%s, so %s would change nothing; leave it out, or give --task",
                 file.path.c_str(), option == "--dataset" ? ", of a run that read no file" : "", option.c_str());
    if (arguments.has("--dataset")) find_data_again(settings, data_set_file(arguments["--dataset"]), file.path);
    return settings;
}

// One of the runs that a train command asks for.
struct PlannedRun {
    Settings settings;
    std::string folder, label;  // label: "2 of 3: ODT, seed 0", or without the count if it is the only run
};

inline std::string method_label(const std::string& method) {
    return method == "dt" ? "DT" : method == "odt" ? "ODT" : "WODTEM";
}

// --out, or runs/TASK-PRESET-METHOD-SEED; several runs in one --out have folders of their own below it.
inline std::string folder_of(const Arguments& arguments, const Settings& settings) {
    if (!arguments.has("--out"))
        return "runs/" + data_name(settings) + "-" + settings.preset + "-" + settings.method + "-" +
               std::to_string(settings.seed);
    return arguments["--out"] + (arguments.has("--methods") ? "/" + settings.method : "") +
           (arguments.has("--seeds") ? "/seed-" + std::to_string(settings.seed) : "");
}

// Every method with every seed, all checked before the first begins. Errors: usage.*, dataset.missing, file.*.
inline std::vector<PlannedRun> planned_runs(const Arguments& arguments) {
    const std::vector<std::string> methods = split(one_or_several(arguments, "--method", "--methods"), ',');
    const std::vector<int64_t> seeds = seed_list(one_or_several(arguments, "--seed", "--seeds"));
    const size_t count = methods.size() * seeds.size();
    std::vector<PlannedRun> runs;
    for (const std::string& method : methods) {
        const Settings* before = runs.empty() ? nullptr : &runs[0].settings;
        const Settings of_method = settings_of(arguments, arguments.words[0], method, before);
        for (const int64_t seed : seeds) {
            Settings settings = of_method;
            settings.seed = seed;
            const std::string folder = folder_of(arguments, settings);
            if (arguments.has("--weights")) {
                settings.weights_path = model_path(arguments["--weights"]);
                require_other_file(folder + "/model.safetensors", settings.weights_path);
                set_from(settings, "first_weights", sha256_of_file(settings.weights_path), "SHA-256 of the model file");
            }
            const std::string place = std::to_string(runs.size() + 1) + " of " + std::to_string(count) + ": ";
            const std::string label = method_label(method) + ", seed " + std::to_string(seed);
            runs.push_back({settings, folder, (count > 1 ? place : "") + label});
        }
    }
    return runs;
}

// The first line of a run.
inline void announce(const PlannedRun& run) {
    const Settings& settings = run.settings;
    const std::string data = settings.task == "gridworld" ? "made on the spot"
                             : settings.dataset == "none" ? "none (random actions)"
                                                          : settings.dataset;
    std::fprintf(stderr, "%s: task %s, preset %s, data set %s, folder %s; all settings: %s/settings\n",
                 run.label.c_str(), settings.task.c_str(), settings.preset.c_str(), data.c_str(), run.folder.c_str(),
                 run.folder.c_str());
}

// One for each method of a sweep, all checked but for a task's data set, which its machine must have. Errors: usage.*,
// and for own data those of load_own_data().
inline std::vector<Settings> swept_settings(const Arguments& arguments) {
    std::vector<Settings> sweep;
    for (const std::string& method : split(arguments["--methods"], ',')) {
        const std::string task = arguments.words.empty() ? "gridworld" : arguments.words[0];
        sweep.push_back(chosen_settings(arguments, task, method, sweep.empty() ? nullptr : &sweep[0]));
        apply_assignments(sweep.back(), arguments.assignments);
        check_together(sweep.back());
    }
    return sweep;
}

// One train command a line; in an estimate all lines are comments. seconds: of one seed of each method.
inline void print_sweep(const std::vector<Settings>& sweep, const Arguments& arguments, double seconds) {
    const bool estimate = arguments.has("--estimate");
    const std::vector<int64_t> seeds = seed_list(arguments["--seeds"]);
    const std::string file = arguments.words.empty() ? "" : shell_word(arguments.words[0]);
    std::string shared;
    for (const auto& [option, usual] : {std::pair("--dataset", ""), {"--kernel", "auto"}, {"--precision", "fp32"}})
        if (arguments[option] != usual) shared += std::string(" ") + option + " " + shell_word(arguments[option]);
    if (arguments.has("--clip-actions")) shared += " --clip-actions";
    for (const std::string& assignment : arguments.assignments) shared += " --set " + shell_word(assignment);
    for (const Settings& settings : sweep)
        for (const int64_t seed : seeds)
            std::printf("%s./wodtem train %s --method %s --preset %s --seed %lld%s\n", estimate ? "# " : "",
                        settings.task == own_data ? file.c_str() : settings.task.c_str(), settings.method.c_str(),
                        settings.preset.c_str(), static_cast<long long>(seed), shared.c_str());
    if (estimate)
        std::printf("# about %.1f hours on this machine, one after the other; what is interrupted continues\n",
                    seconds * static_cast<double>(seeds.size()) / 3600);
}

// The command `tasks TASK`: what `train` would begin with, in two parts, which together are a file of settings.
inline void print_settings(const Arguments& arguments) {
    Settings settings = chosen_settings(arguments, arguments.words[0], arguments["--method"]);
    if (find_mujoco_task(settings.task)) {
        const PublishedDataSet* published = find_published(settings.task);
        if (published) settings.dataset = file_name(*published);
        settings.source["dataset"] = "the task's, if it is named after one; or see --dataset";
        settings.mujoco = mujoco_version();
    }
    for (const bool for_set : {false, true}) {
        std::printf("# %s:\n", for_set ? "Settings for --set" : "Decided by options, or by what they name");
        for (const std::string& line : split(settings_text(settings), '\n'))
            if (!line.empty() && contains(not_for_set, line.substr(0, line.find(' '))) != for_set)
                std::printf("%s\n", line.c_str());
    }
}

// The help of train: every setting.
inline std::string settings_help() {
    std::string text =
        "\nSettings for --set, with the grid world's values in preset small (for others: wodtem tasks TASK --preset "
        "NAME):\n";
    const Settings settings = default_settings("gridworld", "wodtem", "small");
    for (const SettingRow& row : setting_rows) {
        if (contains(not_for_set, row.name)) continue;
        char line[300];
        std::snprintf(line, sizeof line, "  %-24s %-12s %s\n", row.name, setting_text(settings, row).c_str(),
                      source_of(settings, row).c_str());
        text += line;
    }
    return text;
}
