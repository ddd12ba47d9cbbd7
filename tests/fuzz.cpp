// fuzz.cpp: what the program does with files and words of others, as targets of libFuzzer (`make fuzz`, tests/fuzz.sh)
// and as functions that a test calls on what is stored in tests/fuzz/ (tests/test_wodtem.cpp).
//
// run_target(target, input) may return or throw Error. Anything else is a finding: another exception, a signal, a
// sanitizer's report, a second of work, memory out of proportion, or a promise that does not hold (require_same).
#ifndef WODTEM_NO_MAIN
#define WODTEM_NO_MAIN
#include "../wodtem.cpp"
#endif

namespace fuzz {

// A folder of the process, for targets that read paths.
const std::string& scratch() {
    static const std::string path =
        std::filesystem::temp_directory_path() / ("wodtem-fuzz-" + std::to_string(::getpid()));
    std::filesystem::create_directories(path + "/run");
    return path;
}

// Writes a file that nobody has to find after a power cut.
std::string put(const std::string& name, std::string_view bytes) {
    const std::string path = scratch() + "/" + name;
    File(path, O_WRONLY | O_CREAT | O_TRUNC, "file.write", "create it").write(bytes);
    return path;
}

void require_same(bool same) {
    if (!same) throw std::logic_error("what was read, written and read again is not the same");
}

// What a file asks for is its own affair, as long as it is honest; what it costs here is not.
bool is_small(const Settings& s) {
    return (s.task == "gridworld" || (s.task == own_data && std::max({s.state_dim, s.action_dim, s.moves}) <= 32)) &&
           s.layers <= 2 && s.width <= 32 && s.context_length <= 32 && s.batch_size <= 64 && s.table_size <= 100000 &&
           s.eval_episodes <= 4 && s.data_trajectories <= 100 && s.projected_dim <= 64;
}

Compute& compute() {
    static Compute one(kernel_for("plain"), 1);
    return one;
}

// A data set of D4RL or Minari: all that `info` and `train --dataset` do with it.
void hdf5(const std::string& input) {
    const Hdf5File file = parse_hdf5(input, "input");
    for (const std::string& name : file.names()) try {
            const Hdf5Dataset* const dataset = file.find(name);
            if (!dataset) continue;  // a link to a group
            require_same(file.read<float>(*dataset).size() == dataset->elements);
            file.read_flags(*dataset);
        } catch (const Error&) {
        }
    for (const char* name : {"hopper-medium-v2", "antmaze-umaze-v2", "maze2d-umaze-v1"}) try {
            const MujocoTask& task = *find_mujoco_task(name);
            const Rows rows = read_data_set(file, &task);
            const std::vector<Trajectory> trajectories = cut_trajectories(rows, task, "input");
            require_sound(rows, "input");
            describe(statistics_of(rows, trajectories));
            remark_on_places(rows, task, rows_outside(rows, task));
            remarks_on(rows, task, "d4rl", transitions_of_each_physics(rows, task));
        } catch (const Error&) {
        }
    const Rows rows = read_data_set(file);
    describe(statistics_of(rows, cut_at_flags(rows, 1000)));
    number_of_moves(rows, "input");
}

// tests/hdf5/*.z: the size in 8 bytes, then a zlib stream.
void inflate(const std::string& input) {
    const Bytes bytes = as_bytes(input);
    if (bytes.size() < 8 || little_endian(bytes.first(8)) > 1 << 20) return;
    inflate_zlib(bytes.subspan(8), little_endian(bytes.first(8)));
}

void safetensors(const std::string& input) {
    const TensorFile file = parse_safetensors(input, "input");
    for (const StoredTensor& tensor : file.tensors) value_range(file.numbers(tensor));
    const auto written = [](const TensorFile& of) { return file_start(of) += of.data(); };
    require_same(written(parse_safetensors(written(file), "copy")) == written(file));
}

void settings(const std::string& input) {
    const Settings read = settings_from_text(input, "input");
    const std::string written = settings_text(read);
    require_same(settings_text(settings_from_text(written, "copy")) == written);
    train_command(read);
    if (is_small(read)) make_data_set(read);
}

// `train` with the checkpoint of a run: the state is loaded, and one update is made.
void checkpoint(const std::string& input) {
    const Settings s = settings_in(read_own_safetensors(put("run/checkpoint.safetensors", input)));
    if (!is_small(s)) return;
    RunFolder folder{scratch() + "/run"};
    Run run(compute(), s, *make_environment(s));
    load_state(folder, s, [&](auto& archive) { visit_state(archive, run); });
    if (run.progress.online == 0) start_offline(run, offline_set(make_data_set(s), s.keep_lowest));
    update(run);
}

// `eval` and `export`.
void model(const std::string& input) {
    const TensorFile file = open_model(put("model", input));
    const Settings s = settings_in(file);
    if (!is_small(s)) return;
    Agent agent(s, spec_of(s));
    ModelContents contents = contents_of(agent);
    load_model(contents, file);
    Tape<float> acting(compute());
    acting.recording = false;
    if (s.task == own_data) {
        Episode episode;
        for (episode.state.resize(s.state_dim); episode.trajectory.length() < 3;) {
            append_target(episode, s.g_eval, s.reward_scale);
            if (act(agent, acting, episode).empty()) break;
        }
        return;
    }
    evaluate(agent, acting, Environments(*make_environment(s), s.eval_episodes).all(),
             first_of_last_evaluation(contents, s));
}

void import(const std::string& input) {
    const TensorFile file = read_safetensors(put("odt", input));
    const Settings s = settings_in(file);
    if (!is_small(s)) return;
    import_odt(file, s, scratch() + "/imported", [&](StoredModel& stored) {
        const Normaliser normaliser = fit_normaliser(make_data_set(s), stored.spec.state_dim);
        stored.state_mean = normaliser.mean;
        stored.state_std = normaliser.deviation;
    });
    open_model(scratch() + "/imported");
}

// The files of a run folder, each ended by a byte 0.
void report(const std::string& input) {
    const std::vector<std::string> parts = split(input, '\0');
    const char* const names[] = {"settings",  "progress.csv", "episodes.csv", "policy.csv", "start_actions.csv",
                                 "paths.csv", "finished",     "seconds.csv",  "command"};
    for (size_t i = 0; i < std::size(names); ++i) {
        std::filesystem::remove(scratch() + "/run/" + names[i]);
        if (i < parts.size()) put(std::string("run/") + names[i], parts[i]);
    }
    ::report({scratch() + "/run"}, scratch() + "/report");
}

void check(const std::string& input) { vectors::check_file(put("vectors", input), compute(), true); }

// Words, one a line: what a command line asks for is worked out, and nothing is done.
void command_line(const std::string& input) {
    static std::vector<Command> parsed;
    if (parsed.empty())
        for (const Command& command : commands) {
            parsed.push_back(command);
            if (std::string_view(command.name) == "tasks") continue;  // which only prints
            parsed.back().run = [](const Arguments& a) {
                if (a.options.contains("--kernel")) kernel_of(a);
                if (a.options.contains("--threads")) thread_count(a);
                if (a.options.contains("--methods") && a.options.contains("--out")) planned_runs(a);
                if (a.options.contains("--estimate")) print_sweep(swept_settings(a), a, 1);
                for (const char* number : {"--steps", "--episodes", "--checkpoint-every"})
                    if (a.has(number)) whole_number(a[number], number, 0, 1000);
            };
        }
    run_command_line(parsed, split(input, '\n'));
}

struct Target {
    const char* name;
    void (*run)(const std::string&);
};
const Target targets[] = {{"hdf5", hdf5},
                          {"inflate", inflate},
                          {"safetensors", safetensors},
                          {"settings", settings},
                          {"checkpoint", checkpoint},
                          {"model", model},
                          {"import", import},
                          {"report", report},
                          {"check", check},
                          {"command_line", command_line}};

// Errors: fuzz.target, and those of the target, all of them Error.
void run_target(const std::string& target, const std::string& input) {
    const auto found = std::ranges::find(targets, target, &Target::name);
    require(found != std::end(targets), "fuzz.target", "there is no target ", target);
    found->run(input);
}

}  // namespace fuzz

#ifdef FUZZ  // the target's name is in the environment, as libFuzzer takes the arguments
extern "C" int LLVMFuzzerInitialize(int*, char***) {
    if (!std::freopen("/dev/null", "w", stdout)) std::abort();
    return 0;
}

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* bytes, size_t size) {
    static const std::string target = std::getenv("FUZZ_TARGET") ? std::getenv("FUZZ_TARGET") : "";
    try {
        fuzz::run_target(target, {reinterpret_cast<const char*>(bytes), size});
    } catch (const Error&) {
    }
    return 0;
}
#endif
