// info.hpp: what is in a file, in words: a data set (HDF5), a model, a checkpoint or golden vectors (safetensors); and
// the list of tasks.
#pragma once

#include "d4rl.hpp"

// ---------------------------------------------------------------------------------------------------------------------
// Data sets.

inline void print_datasets(const Hdf5File& file) {
    constexpr size_t listed = 40;
    for (const Hdf5Dataset& dataset : file.datasets | std::views::take(listed))
        std::printf("  %-40s %-18s %-12s %zu bytes stored%s%s\n", json_string(dataset.path).c_str(),
                    shape_text(dataset.shape).c_str(), dataset.type.c_str(), dataset.stored,
                    dataset.unsupported.empty() ? "" : "; cannot be read: ", dataset.unsupported.c_str());
    if (file.datasets.size() > listed) std::printf("  and %zu more\n", file.datasets.size() - listed);
}

// D4RL's own figures of a published data set, where they are known.
inline void print_published(const PublishedDataSet* set) {
    if (!set || set->trajectories == 0) return;
    if (std::isnan(set->deviation))
        std::printf("D4RL's: %d trajectories, mean return %.2f\n", set->trajectories, set->mean_return);
    else
        std::printf("D4RL's: %d trajectories, returns: mean %.2f, deviation %.2f, %.2f to %.2f\n", set->trajectories,
                    set->mean_return, set->deviation, set->low, set->high);
}

// Prints what the file holds, then what it means for a task. `id` names the task; "": it follows from the file's name
// or checksum. Errors: those of reading the file.
inline void print_data_set(const std::string& path, std::string id) {
    const Hdf5File file = open_hdf5(path);
    const std::string sha256 = sha256_of_file(path);
    std::printf("%s: HDF5, %zu bytes, SHA-256 %s\n", path.c_str(), file.bytes.size(), sha256.c_str());
    for (const PublishedDataSet& set : published_data_sets) {
        const bool published = sha256 == set.sha256;
        if (published) std::printf("This is D4RL's published file of %s.\n", set.id);
        if (id.empty() && (published || std::filesystem::path(path).filename() == file_name(set))) id = set.id;
    }
    print_datasets(file);
    if (!is_minari(file) && !file.find("observations")) return;
    const MujocoTask* task = find_mujoco_task(id);
    const Rows rows = read_data_set(file, task);
    if (!task)
        std::printf("The name tells no task, so there is no score, and flags alone end trajectories (see --task)\n");
    const std::vector<Trajectory> trajectories =
        task ? cut_trajectories(rows, *task, path) : cut_at_flags(rows, std::numeric_limits<size_t>::max());
    const DataSetStatistics statistics = statistics_of(rows, trajectories);
    std::printf("rows:         %zu, %zu state and %zu action numbers\n%s", rows.count, rows.state_dim, rows.action_dim,
                describe(statistics).c_str());
    if (task)
        std::printf("mean normalised score of a trajectory: %.2f (%s)\n",
                    normalised_score(*task, statistics.returns.mean()), task->name);
    if (task) {
        const TransitionsOfPhysics transitions = transitions_of_each_physics(rows, *task);
        for (size_t i = 0; i < transitions.size(); ++i) {
            if (transitions[i].empty()) continue;
            const std::optional<size_t> first = first_far_off(transitions[i]);
            std::printf(
                "physics %-4s %zu recorded steps taken again end %.2g from the recorded state (median), at most "
                "%.2g%s\n",
                physics_names[i], transitions[i].size(), median_of(transitions[i]), transitions[i].back().difference,
                first ? text_of("; the first that ends ", far_off, " or more from it is row ", *first).c_str() : "");
        }
        const std::string places = remark_on_places(rows, *task, rows_outside(rows, *task));
        if (!places.empty()) std::printf("note: %s\n", places.c_str());
        for (const std::string& remark : remarks_on(rows, *task, "d4rl", transitions))
            std::printf("note: %s\n", remark.c_str());
    }
    if (const std::string remark = remark_on_outliers(rows); !remark.empty()) std::printf("note: %s\n", remark.c_str());
    print_published(find_published(id));
}

// ---------------------------------------------------------------------------------------------------------------------
// Safetensors.

// Least, greatest and mean of the finite numbers, and the count of the others.
inline std::string value_range(std::vector<double> values) {
    const size_t others = std::erase_if(values, [](double x) { return !std::isfinite(x); });
    if (values.empty()) return "nothing finite";
    Moments finite;
    for (const double value : values) finite.add(value);
    char text[160];
    std::snprintf(text, sizeof text, "%.6g to %.6g, mean %.6g", finite.low, finite.high, finite.mean());
    return text + (others > 0 ? ", NOT FINITE: " + std::to_string(others) : std::string());
}

inline void print_tensors(const std::string& path) {
    const TensorFile file = read_safetensors(path);
    std::printf("%s: safetensors, %zu bytes, crc32 %s\n", path.c_str(), file.buffer.size(),
                hex8(crc32(file.buffer)).c_str());
    for (const auto& [key, text] : file.metadata) {
        std::string shown = key + (text.find('\n') == std::string::npos ? ": " : ":\n") + text;
        for (char& c : shown)
            if (static_cast<unsigned char>(c) < ' ' && c != '\n') c = '?';  // control characters drive a terminal
        std::printf("%s%s", shown.c_str(), shown.ends_with('\n') ? "" : "\n");
    }
    for (const StoredTensor& tensor : file.tensors)
        std::printf("%-44s %s %-14s %s\n", tensor.name.c_str(), about(tensor.dtype).name,
                    shape_text(tensor.shape).c_str(), value_range(file.numbers(tensor)).c_str());
}

// The command `info`. task: a task's id, or "". Errors: those of data_set_file() and of reading.
inline void print_info(const std::string& given, const std::string& task) {
    const std::string path = data_set_file(given);
    if (is_hdf5(path))
        print_data_set(path, task.empty() ? "" : full_task_name(task));
    else
        print_tensors(path);
}

// The command `tasks` without a task.
inline void print_tasks() {
    const EnvironmentSpec spec = GridWorld{}.spec();
    std::printf("%-30s %3d state numbers, %d moves, at most %d steps; data set: a fixed policy's, made on the spot\n",
                "gridworld", spec.state_dim, spec.discrete_actions, spec.max_episode_steps);
    for (const std::string& id : split(task_names, '|'))
        if (const MujocoTask* task = find_mujoco_task(id))
            std::printf(
                "%-30s %3d state numbers, %d action numbers, at most %d steps; score 0 is a return of %s, 100 %s\n",
                id.c_str(), task->state_dim, task->action_dim, task->max_episode_steps,
                number_text(task->score_low).c_str(), number_text(task->score_high).c_str());
    const bool absent = mujoco_version() == "none";
    std::printf("MuJoCo: %s%s%s\n", mujoco_version().c_str(), absent ? "; " : "", absent ? mujoco_advice : "");
}
