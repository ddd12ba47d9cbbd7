// memory_bytes.hpp: how much memory an episodic memory takes, for the test of its promise and for `wodtem bench`.
#pragma once

#include "../memory.hpp"

// Bytes in use: the saved columns and what is derived from them.
inline size_t memory_bytes(const EpisodicMemory& memory) {
    size_t total = 0;
    const auto add = [&](const auto&... columns) { ((total += columns.capacity() * sizeof(columns[0])), ...); };
    EpisodicMemory::for_each_column(memory, [&](const char*, const auto& column, size_t) { add(column); });
    const KdTree& tree = memory.tree;
    add(memory.projection, memory.slots, tree.nodes, tree.split_entry, tree.coordinates, tree.entries, tree.free_pairs);
    return total + memory.heap.size() * sizeof(EpisodicMemory::HeapItem);
}
