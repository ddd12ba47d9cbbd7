// dump.hpp: `wodtem check --dump FILE --run DIR`: every intermediate tensor of one update of a run, by name, laid out
// as a case of topic `step`, so that `wodtem check` judges it, and a port that drifts can be bisected. Included by
// wodtem.cpp.
//
// The update is the next one of a run that has a checkpoint, else the first. Dropout is off, and the batch is one part:
// where the run's own update is in parts, sums are added in another order.
#pragma once

namespace vectors {

// A file with one case.
struct Dump {
    TensorFile file;
    std::string name;

    void set(const std::string& key, const std::string& text) { file.metadata[name + "." + key] = text; }
    template <class Values>
    void add(const std::string& tensor, const Shape& shape, const Values& values) {
        file.add(name + "/" + tensor, shape, values);
    }
};

// The trainable state: parameters, and the optimiser's moments where there are any.
void dump_parameters(Dump& dump, const std::vector<Parameter<float>>& parameters, const Optimizer& optimizer) {
    for (size_t i = 0; i < parameters.size(); ++i) {
        const Parameter<float>& parameter = parameters[i];
        if (parameter.name != "log_temperature")
            dump.add("in/parameter/" + parameter.name, parameter.shape, parameter.value);
        if (optimizer.updates == 0) continue;
        dump.add("in/first_moment/" + parameter.name, parameter.shape, optimizer.first_moment[i]);
        dump.add("in/second_moment/" + parameter.name, parameter.shape, optimizer.second_moment[i]);
    }
}

void dump_settings(Dump& dump, const Run& run) {
    const Settings& s = run.agent.settings;
    dump.file.metadata["topic"] = "step";
    dump.file.metadata["equations"] = "WODTEM eqs. (1) to (3) and (5) to (10)";
    dump.file.metadata["cases"] = "1";
    dump.file.metadata["settings"] = settings_text(s);
    dump.set("note", "update " + std::to_string(run.progress.updates + 1) + " of a run, dropout off");
    dump.set("source", "self: wodtem check --dump");
    dump.set("tolerance", "float64 1e-4, float32 1e-4: float32 sums, in whatever order");
    for (const char* name : {"heads", "optimizer", "learning_rate", "weight_decay", "clip_norm", "warmup_updates",
                             "lambda_learning_rate", "eta"})
        dump.set(name, setting_text(s, setting_row(name)));
    dump.set("always_adapt", s.lamb_always_adapt ? "1" : "0");
    dump.set("updates_before", std::to_string(run.optimizer.updates));
    if (run.agent.uses_memory()) dump.set("alpha", number_text(s.alpha));
    if (run.agent.uses_memory()) dump.set("tau", number_text(s.tau));
}

// The batch, and of each step what the memory knows: its neighbours (count of them; distance, e and action of each,
// closest first), d, the number that draws a-hat -> e_hat, w, a_hat (NaN: none is drawn).
void dump_batch(Dump& dump, const Run& run, const Batch& batch, const std::vector<float>& noise) {
    const uint64_t n = batch.coefficients.size(), K = batch.neighbours.K;
    const uint64_t A = run.agent.spec.action_dim, S = run.agent.spec.state_dim;
    const Shape actions = run.agent.spec.discrete_actions > 0 ? Shape{n} : Shape{n, A};
    const std::vector<int>& lengths = batch.sequences.lengths;
    dump.add("in/lengths", {lengths.size()}, std::vector<int64_t>(lengths.begin(), lengths.end()));
    dump.add("in/timesteps", {n},
             std::vector<int64_t>(batch.sequences.timesteps.begin(), batch.sequences.timesteps.end()));
    dump.add("in/returns_to_go", {n}, batch.sequences.returns_to_go);
    dump.add("in/states", {n, S}, batch.sequences.states);
    dump.add("in/actions", actions, batch.actions);
    dump.add("in/weights", {n}, batch.weights);
    dump.add("in/remembered_actions", actions, batch.advised_actions);
    if (!noise.empty()) dump.add("in/noise", {n, A}, noise);
    if (!run.agent.uses_memory()) return;
    std::vector<int64_t> count;
    std::vector<float> distance(n * K, INFINITY), neighbour_actions(n * K * A), a_hat(n * A, NAN);
    std::vector<double> e(n * K), e_hat, w, uniform;
    for (size_t i = 0; i < n; ++i) {
        const std::span<const Neighbour> found = batch.neighbours[i];
        count.push_back(static_cast<int64_t>(found.size()));
        for (size_t k = 0; k < found.size(); ++k) {
            distance[i * K + k] = found[k].distance;
            e[i * K + k] = run.memory.e[found[k].entry];
            std::copy_n(&run.memory.actions[found[k].entry * A], A, &neighbour_actions[(i * K + k) * A]);
        }
        e_hat.push_back(approximate_return(run.memory, found));
        const bool optimal = run.memory.is_optimal(found, batch.discounted_returns[i]);
        w.push_back(EpisodicMemory::weight(optimal, run.agent.settings.alpha));
        uniform.push_back(
            run.agent.random(Stream::advised_action).uniform(run.progress.updates, batch.random_index[i]));
        if (!optimal) std::copy_n(run.memory.advised_action(found, uniform[i]), A, &a_hat[i * A]);
    }
    dump.add("in/memory/count", {n}, count);
    dump.add("in/memory/distance", {n, K}, distance);
    dump.add("in/memory/e", {n, K}, e);
    dump.add("in/memory/actions", {n, K, A}, neighbour_actions);
    dump.add("in/memory/d", {n}, batch.discounted_returns);
    dump.add("in/memory/uniform", {n}, uniform);
    dump.add("out/memory/e_hat", {n}, e_hat);
    dump.add("out/memory/w", {n}, w);
    dump.add("out/memory/a_hat", {n, A}, a_hat);
}

// Makes the update, and notes everything on the way.
void dump_update(Run& run, const std::string& path) {
    Dump dump{{}, "update_" + std::to_string(run.progress.updates + 1)};
    dump_settings(dump, run);
    std::vector<Parameter<float>>&parameters = run.agent.model.parameters,
    &temperature = run.agent.temperature.log_lambda;
    const bool constrain = run.agent.constrains_entropy();
    dump_parameters(dump, parameters, run.optimizer);
    if (constrain) dump_parameters(dump, temperature, run.agent.temperature.optimizer);
    if (constrain) dump.add("in/log_temperature", {}, temperature[0].value);
    Batch batch = sample_batch(run, 0, static_cast<uint32_t>(run.agent.settings.batch_size));
    consult_memory(run, batch);
    const std::vector<float> noise = entropy_noise(run, batch);
    dump_batch(dump, run, batch, noise);

    Tape<float> tape(run.compute);
    LayerOutputs<float> layers;
    layers.watch(tape);
    const Objective<float> result =
        learn(tape, run.agent.model, batch, noise.data(), run.agent.temperature.lambda(), constrain);
    for (const auto& output : layers.outputs) {
        dump.add("out/layer/" + output.name, output.shape, output.value);
        dump.add("out/layer_gradient/" + output.name, output.shape,
                 std::span<const float>(output.gradient->data, output.value.size()));
    }
    for (const Parameter<float>& parameter : parameters)
        dump.add("out/gradient/" + parameter.name, parameter.shape,
                 std::span<const float>(parameter.gradient.data(), parameter.value.size()));
    dump.add("out/L", {1}, std::array{result.L.value[0]});
    if (constrain) dump.add("out/H", {1}, std::array{result.H.value[0]});
    dump.add("out/loss", {1}, std::array{result.lagrangian.value[0]});
    const double norm = update_parameters(run.compute, parameters, run.optimizer, optimizer_config(run.agent.settings));
    dump.add("out/gradient_norm", {1}, std::array{norm});
    for (const Parameter<float>& parameter : parameters)
        dump.add("out/after_1/" + parameter.name, parameter.shape, parameter.value);
    if (constrain) {
        update_lambda(run.compute, run.agent.temperature, run.agent.settings, static_cast<double>(result.H.value[0]));
        dump.add("out/log_temperature", {1}, temperature[0].value);
    }
    write_safetensors(path, dump.file);
    std::printf("%s: update %llu, %zu tensors\n", path.c_str(),
                static_cast<unsigned long long>(run.progress.updates + 1), dump.file.tensors.size());
}

// Errors: dump.weights, dump.dataset, file.input; those of the data set.
void dump_run(const std::string& path, RunFolder folder, const Arguments& arguments) {
    Settings settings = settings_from_text(read_file(folder.file("settings"), 1 << 20), folder.file("settings"));
    const bool resumes = folder.has("checkpoint.safetensors");
    require(settings.first_weights == "none" || resumes, "dump.weights", folder.path,
            " began with a model's weights, which it does not hold; dump it while it has a checkpoint");
    if (settings.behaviour == "recorded") {
        const PublishedDataSet* published = find_published(settings.task);
        const std::string& given = arguments["--dataset"];
        require(published || !given.empty(), "dump.dataset", folder.path, ": give its data set by --dataset");
        find_data_again(settings, given.empty() ? find_data_set(*published) : data_set_file(given), folder.path);
    }
    for (const std::string& input :
         {folder.file("settings"), folder.file("checkpoint.safetensors"), settings.dataset_path})
        require_other_file(path, input);
    Compute compute(kernel_for(settings.arithmetic), thread_count(arguments));
    Run run(compute, settings, *make_environment(settings));
    if (resumes)
        load_state(folder, settings, [&](auto& archive) { visit_state(archive, run); });
    else
        begin_run(run, make_data_set(settings));
    if (resumes && run.progress.online == 0)
        start_offline(run, offline_set(make_data_set(settings), settings.keep_lowest));
    run.agent.model.config.dropout = 0;
    dump_update(run, path);
}

}  // namespace vectors
