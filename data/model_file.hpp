// model_file.hpp: a trained model as a safetensors file, and the same weights under the names of ODT's own code.
//
// A model file holds the network's parameters under ODT's names, `log_temperature` [], `state_mean` and `state_std`
// [state_dim], and in its metadata the format, the settings and the counts of updates, interactions and evaluations:
// all that `eval` needs. A file for ODT's code holds exactly what a strict load_state_dict of its model expects, that
// is also tensors which it neither trains nor uses; what it has no place for goes into the metadata, as decimal text
// that reads back exactly.
// Promises: a file is checked against the network of its settings before anything of it is used; errors name the file
// and the tensor. Leaves out: moments, replay buffer and memory (run_folder.hpp's checkpoint).
#pragma once

#include "safetensors.hpp"
#include "settings.hpp"  // and with it the other standard headers

// Where the contents of a model file lie in memory; reading writes to these places.
struct ModelContents {
    const Settings& settings;
    const TransformerConfig& config;
    std::vector<Parameter<float>>& parameters;
    Parameter<float>& log_temperature;
    std::vector<float>&state_mean, &state_std;  // [config.state_dim]
    uint64_t updates = 0, interactions = 0, evaluations = 0;
};

// What model files and files for ODT's code have in common: the metadata and the network's parameters.
inline TensorFile network_file(const ModelContents& model, const char* format) {
    TensorFile file;
    file.metadata = {{"format", format},
                     {"settings", settings_text(model.settings)},
                     {"updates", std::to_string(model.updates)},
                     {"interactions", std::to_string(model.interactions)},
                     {"evaluations", std::to_string(model.evaluations)}};
    for (const Parameter<float>& parameter : model.parameters)
        file.add(parameter.name, parameter.shape, parameter.value);
    return file;
}

// ---------------------------------------------------------------------------------------------------------------------
// The model file.

inline constexpr const char* model_format = "wodtem model 1";

// Errors: file.write.
inline void save_model(const ModelContents& model, const std::string& path) {
    TensorFile file = network_file(model, model_format);
    file.add("log_temperature", {}, model.log_temperature.value);
    file.add("state_mean", {model.state_mean.size()}, model.state_mean);
    file.add("state_std", {model.state_std.size()}, model.state_std);
    write_safetensors(path, file);
}

// "a", "b" and 3 more; for messages.
inline std::string some_names(const std::vector<std::string>& names) {
    std::string text;
    for (size_t i = 0; i < std::min<size_t>(names.size(), 8); ++i) text += (i > 0 ? ", " : "") + json_string(names[i]);
    return text + (names.size() > 8 ? " and " + std::to_string(names.size() - 8) + " more" : "");
}

// Reads the parameters, of any kind of float. Beside them the file may have the tensors `known`, and no others.
// Errors: model.names names the missing and the unknown ones; those of get_floats() for a wrong shape or dtype.
inline void load_parameters(ModelContents& model, const TensorFile& file, std::set<std::string> known) {
    std::vector<std::string> missing, unknown;
    for (const Parameter<float>& parameter : model.parameters) {
        known.insert(parameter.name);
        if (!file.has(parameter.name)) missing.push_back(parameter.name);
    }
    for (const StoredTensor& tensor : file.tensors)
        if (!known.contains(tensor.name)) unknown.push_back(tensor.name);
    std::string differences = missing.empty() ? "" : "missing " + some_names(missing);
    if (!unknown.empty()) differences += (missing.empty() ? "unknown " : "; unknown ") + some_names(unknown);
    require(differences.empty(), "model.names", file.path, ": does not hold the network of its settings: ", differences,
            "; are layers, position and method right?");
    for (Parameter<float>& parameter : model.parameters)
        // In place: the tape and the packed weights know a parameter by its address.
        std::ranges::copy(file.get_floats(parameter.name, parameter.shape), parameter.value.begin());
}

// Errors: model.value names the tensor that holds a number no network can have.
inline void check_model(const ModelContents& model, const std::string& path) {
    const auto require_value = [&](bool holds, const std::string& name, const char* property) {
        require(holds, "model.value", path, ": tensor ", name, " holds a number that is not ", property);
    };
    for (const Parameter<float>& parameter : model.parameters)
        for (const float value : parameter.value) require_value(std::isfinite(value), parameter.name, "finite");
    const float log_temperature = model.log_temperature.value[0];
    const bool finite = std::isfinite(log_temperature) && std::isfinite(std::exp(log_temperature));
    require_value(finite, "log_temperature", "finite, nor is its exponential");
    for (const float value : model.state_mean) require_value(std::isfinite(value), "state_mean", "finite");
    for (const float value : model.state_std)
        require_value(std::isfinite(value) && value > 0, "state_std", "finite and positive");
}

// The counts in the metadata; 0 where the file does not state them. Errors: import.metadata.
inline void load_counts(ModelContents& model, const TensorFile& file) {
    const auto count = [&](const char* name) -> uint64_t {
        const auto found = file.metadata.find(name);
        if (found == file.metadata.end()) return 0;
        const std::optional<double> x = to_number(found->second);
        require(x && *x >= 0 && *x <= 1e15 && *x == std::floor(*x), "import.metadata", file.path, ": metadata entry ",
                name, " is \"", found->second.substr(0, 80), "\", not a number of ", name);
        return static_cast<uint64_t>(*x);
    };
    model.updates = count("updates");
    model.interactions = count("interactions");
    model.evaluations = count("evaluations");
}

inline constexpr const char* checkpoint_format = "wodtem checkpoint 2";  // of run_folder.hpp

// "commit 1a2b3c4; wodtem checkpoint 2; g++ 12.2.0", as seconds.csv has it; no commas. The Makefile says which commit.
inline std::string program_text() {
#ifdef WODTEM_COMMIT
    const std::string commit = WODTEM_COMMIT;
#else
    const std::string commit;
#endif
    return "commit " + (commit.empty() ? "unknown" : commit) + "; " + checkpoint_format + "; g++ " + __VERSION__;
}

// Reads the network of an unfinished run from its checkpoint. Errors: model.value, safetensors.*.
inline void load_unfinished(ModelContents& model, const TensorFile& file) {
    const uint64_t state_dim = static_cast<uint64_t>(model.config.state_dim);
    for (Parameter<float>& parameter : model.parameters)
        file.read_into(std::span(parameter.value), "model.value." + parameter.name, {parameter.value.size()});
    file.read_into(std::span(model.log_temperature.value), "temperature.value.log_temperature", {1});
    model.state_mean = file.get<float>("normaliser.mean", {state_dim});
    model.state_std = file.get<float>("normaliser.deviation", {state_dim});
    check_model(model, file.path);
    model.updates = file.get<uint64_t>("progress.updates", {})[0];
    model.interactions = file.get<uint64_t>("progress.interactions", {})[0];
    model.evaluations = file.get<uint64_t>("progress.evaluations", {})[0];
}

// Reads what save_model() wrote, or a checkpoint. Errors: model.names, model.value, import.metadata, safetensors.*.
inline void load_model(ModelContents& model, const TensorFile& file) {
    if (file.text("format") == checkpoint_format) return load_unfinished(model, file);
    const uint64_t state_dim = static_cast<uint64_t>(model.config.state_dim);
    load_parameters(model, file, {"log_temperature", "state_mean", "state_std"});
    file.read_into(std::span(model.log_temperature.value), "log_temperature", {});
    model.state_mean = file.get<float>("state_mean", {state_dim});
    model.state_std = file.get<float>("state_std", {state_dim});
    check_model(model, file.path);
    load_counts(model, file);
}

// The settings in a file's metadata. Errors: settings.*, safetensors.metadata.
inline Settings settings_in(const TensorFile& file) { return settings_from_text(file.text("settings"), file.path); }

// Demands that a file is large enough for the network of its settings, before a network of that size is allocated.
// Errors: model.settings.
inline void require_room(const TensorFile& file, const Settings& settings) {
    const bool sizes = settings.task != own_data || (settings.state_dim > 0 && settings.action_dim > 0 &&
                                                     (settings.moves == 0 || settings.action_dim == 1));
    require(sizes && settings.width % settings.heads == 0, "model.settings", file.path,
            ": its settings state_dim, action_dim, moves, or width and heads do not go together");
    const EnvironmentSpec spec = spec_of(settings);
    const int64_t numbers = spec.state_dim + 2 * std::max(spec.action_dim, spec.discrete_actions);
    const int64_t weights = settings.width * (12 * settings.layers * settings.width + numbers);
    require(static_cast<uint64_t>(weights) <= file.buffer.size() / about(DType::F16).size, "model.settings", file.path,
            ": does not hold the ", weights, " weights and more that its settings call for");
}

// Returns the path of a model: `given` itself, or the model file of the run's folder `given`. Errors: model.unfinished
// for the folder of a run that goes on, whose model file is of a smaller budget.
inline std::string model_path(const std::string& given) {
    std::error_code error;  // of a name that no file can have
    if (!std::filesystem::is_directory(given, error)) return given;
    require(is_there(given + "/finished") || !is_there(given + "/checkpoint.safetensors"), "model.unfinished", given,
            ": the run is unfinished; finish it, or name its file model.safetensors");
    return given + "/model.safetensors";
}

// Errors: model.format, model.settings, safetensors.*, file.*.
inline TensorFile open_model(const std::string& given) {
    TensorFile file = read_safetensors(model_path(given));
    require(file.metadata.contains("format") && file.text("format") == model_format, "model.format", file.path,
            " is a safetensors file, but no model that `wodtem train` has written");
    require_room(file, settings_in(file));
    return file;
}

// A model; of the folder of an unfinished run its checkpoint, which has the present network. Errors: those of
// open_model(), checkpoint.format.
inline TensorFile open_model_or_checkpoint(const std::string& given) {
    const std::string checkpoint = given + "/checkpoint.safetensors";
    if (is_there(given + "/finished") || !is_there(checkpoint)) return open_model(given);
    TensorFile file = read_own_safetensors(checkpoint);
    require(file.text("format") == checkpoint_format, "checkpoint.format", checkpoint,
            " is no checkpoint of this version of `wodtem train`");
    require_room(file, settings_in(file));
    std::fprintf(stderr, "%s: the run is unfinished; this is its network after %s updates\n", given.c_str(),
                 number_text(file.get<uint64_t>("progress.updates", {})[0]).c_str());
    return file;
}

// The number of the first episode of a run's last evaluation among those of all its evaluations, by the run's settings.
inline uint64_t first_of_last_evaluation(const ModelContents& model, const Settings& settings) {
    return (std::max<uint64_t>(1, model.evaluations) - 1) * static_cast<uint64_t>(settings.eval_episodes);
}

// Reads the first network of a run from a model of the same shape. Errors: model.settings, and those of load_model().
inline void load_first_weights(ModelContents& model, const TensorFile& file) {
    const Settings theirs = settings_in(file);
    for (const char* name : {"layers", "heads", "width", "position", "state_encoding"}) {
        const SettingRow& row = setting_row(name);
        const std::string its = setting_text(theirs, row), ours = setting_text(model.settings, row);
        require(its == ours, "model.settings", file.path, " has ", name, " = ", its, ", the run ", ours,
                "; make them equal with --set");
    }
    load_model(model, file);
}

// ---------------------------------------------------------------------------------------------------------------------
// ODT's state_dict.

// The names and shapes of the tensors that ODT's code saves and this program does not use: GPT-2's vocabulary of one
// word; max_ep_len 1000; causal masks for n_positions 1024; heads for state and return, which no loss reads.
inline std::vector<std::pair<std::string, Shape>> unused_odt_tensors(const TransformerConfig& config) {
    const uint64_t d = static_cast<uint64_t>(config.width), S = static_cast<uint64_t>(config.state_dim);
    std::vector<std::pair<std::string, Shape>> unused = {
        {"transformer.wte.weight", {1, d}}, {"embed_timestep.weight", {1000, d}}, {"predict_state.weight", {S, d}},
        {"predict_state.bias", {S}},        {"predict_return.weight", {1, d}},    {"predict_return.bias", {1}}};
    for (int layer = 0; layer < config.layers; ++layer) {
        const std::string attention = "transformer.h." + std::to_string(layer) + ".attn.";
        unused.push_back({attention + "bias", {1, 1, 1024, 1024}});
        unused.push_back({attention + "masked_bias", {}});
    }
    return unused;
}

// The numbers of a tensor, or of the metadata entry of its name, where they are separated by spaces; nothing if the
// file has neither. Errors: import.metadata.
inline std::vector<float> tensor_or_text(const TensorFile& file, const std::string& name, const Shape& shape) {
    const size_t size = shape.empty() ? 1 : shape[0];
    if (file.has(name)) return file.get_floats(name, shape);
    if (!file.metadata.contains(name)) return {};
    std::vector<float> values;
    bool finite = true;
    for (const std::string& word : split(file.text(name), ' ')) {
        const char* const end = word.data() + word.size();
        float& value = values.emplace_back(NAN);
        finite = finite && std::from_chars(word.data(), end, value).ptr == end && std::isfinite(value);
    }
    require(finite && values.size() == size, "import.metadata", file.path, ": metadata entry ", name, " is not ", size,
            " finite number", size == 1 ? "" : "s", " separated by spaces");
    return values;
}

// A model in memory that neither trains nor acts.
struct StoredModel {
    Settings settings;
    EnvironmentSpec spec = spec_of(settings);
    Transformer<float> network{transformer_config(settings, spec), 0};
    Parameter<float> log_temperature{
        "log_temperature", {1}, {std::log(static_cast<float>(settings.initial_lambda))}, {0}};
    std::vector<float> state_mean = {}, state_std = {};

    ModelContents contents() {
        return {settings, network.config, network.parameters, log_temperature, state_mean, state_std};
    }
};

// The command `export --odt`: from a model file (or run folder) to `out`, which gets everything that a strict
// load_state_dict of ODT's model expects, and nothing else. What it has no place for is text in the metadata.
// Errors: those of open_model() and load_model(), file.input, file.write.
inline void export_odt(const std::string& given, const std::string& out) {
    const TensorFile file = open_model(given);
    require_other_file(out, file.path);
    StoredModel model{settings_in(file)};
    ModelContents contents = model.contents();
    load_model(contents, file);
    TensorFile exported = network_file(contents, "ODT state_dict");
    const auto set_text = [&](const char* name, const std::vector<float>& values) {
        std::string& text = exported.metadata[name];
        for (const float value : values) text += (text.empty() ? "" : " ") + number_text(value);
    };
    set_text("log_temperature", model.log_temperature.value);
    set_text("state_mean", model.state_mean);
    set_text("state_std", model.state_std);
    std::vector<uint8_t> causal_mask(1024 * 1024);  // [query, key]
    for (size_t i = 0; i < causal_mask.size(); ++i) causal_mask[i] = i % 1024 <= i / 1024;
    for (const auto& [name, shape] : unused_odt_tensors(model.network.config)) {
        const float value = name.ends_with(".masked_bias") ? -1e4f : 0.0f;
        if (name.ends_with(".attn.bias"))
            exported.add(name, shape, causal_mask);
        else
            exported.add(name, shape, std::vector<float>(*byte_size(shape, DType::F32) / sizeof value, value));
    }
    write_safetensors(out, exported);
    std::printf(
        "%s: %zu tensors for a strict load_state_dict of ODT's model%s\n", out.c_str(), exported.tensors.size(),
        model.spec.discrete_actions > 0 ? ", were there not predict_action.logits: ODT has no discrete actions" : "");
}

// The command `import`: from a file of ODT's code or of export_odt() to a model file. find_statistics(model) is called
// if the file has none of the states. Errors: model.*, import.*, file.input, safetensors.*.
void import_odt(const TensorFile& file, const Settings& settings, const std::string& out, const auto& find_statistics) {
    require_other_file(out, file.path);
    require_other_file(out, settings.dataset_path);
    require_room(file, settings);
    StoredModel model{settings};
    ModelContents contents = model.contents();
    std::set<std::string> known = {"log_temperature", "state_mean", "state_std"};
    for (const auto& [name, shape] : unused_odt_tensors(model.network.config)) known.insert(name);
    load_parameters(contents, file, known);
    load_counts(contents, file);
    const std::vector<float> log_temperature = tensor_or_text(file, "log_temperature", {});
    if (!log_temperature.empty()) model.log_temperature.value = log_temperature;
    const uint64_t state_dim = static_cast<uint64_t>(model.spec.state_dim);
    model.state_mean = tensor_or_text(file, "state_mean", {state_dim});
    model.state_std = tensor_or_text(file, "state_std", {state_dim});
    require(model.state_mean.empty() == model.state_std.empty(), "import.metadata", file.path,
            ": has one of state_mean and state_std; it needs both, or neither");
    if (model.state_mean.empty()) {
        const bool has_data = settings.task == "gridworld" || !settings.dataset_path.empty();
        require(has_data, "import.normaliser", file.path,
                " has no state_mean and state_std; give the data set from which to take them by --dataset");
        find_statistics(model);
    }
    check_model(contents, file.path);
    save_model(contents, out);
    std::printf("%s: %s, %s, for wodtem eval and wodtem train --weights\n", out.c_str(), settings.task.c_str(),
                settings.method.c_str());
}
