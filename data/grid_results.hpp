// grid_results.hpp: what the figures of a finished run on the grid world need of the network. Included by wodtem.cpp
// behind the phases, whose functions it calls.
#pragma once

// The learned policy's distribution over actions in every cell, at the start of an evaluation: [36][8].
std::vector<std::vector<float>> policy_by_cell(Run& run, GridWorld world) {
    const Settings& settings = run.agent.settings;
    std::vector<Episode> episodes(grid_cells);  // one that begins in each cell
    std::vector<Episode*> running;
    for (world.cell = 0; world.cell < grid_cells; ++world.cell) {
        Episode& episode = episodes[world.cell];
        episode.state.resize(run.agent.spec.state_dim);
        world.observe(episode.state.data());
        append_target(episode, settings.g_eval, settings.reward_scale);
        running.push_back(&episode);
    }
    run.acting.reset();
    const Policy<float> policy =
        forward(run.acting, run.agent.model, acting_batch(run.agent, running), Queries::last_state);
    std::vector<std::vector<float>> probabilities(grid_cells);
    for (size_t i = 0; i < policy.output.size(); ++i)
        probabilities[i / grid_moves].push_back(std::exp(policy.output.value[i]));
    return probabilities;
}

// What the figures of a finished run on the grid world need: the policy in every cell, and the shares of the moves at S
// (figs. 1d and 4b).
void save_grid_results(Run& run, const RunFolder& folder) {
    const Settings& settings = run.agent.settings;
    const GridWorld world = make_grid_world(settings);
    const std::vector<std::vector<float>> probabilities = policy_by_cell(run, world);
    std::vector<double> online;
    if (run.progress.online != 0) online = moves_at_start(run.replay.trajectories, world);
    save_policy(folder, probabilities);
    save_start_actions(folder, probabilities[grid_start], moves_at_start(make_data_set(settings), world), online);
}
