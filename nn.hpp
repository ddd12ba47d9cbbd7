// nn.hpp: everything numerical that a decision transformer needs, and nothing about reinforcement learning.
#pragma once

#include <array>
#include <cmath>
#include <cstdarg>
#include <cstdint>
#include <cstdio>
#include <stdexcept>
#include <string>
#include <vector>

// ---------------------------------------------------------------------------------------------------------------------
// Errors. Every failure is one sentence for the person at the terminal (what, where, expected and got, what to do) and
// one stable id for tests ("safetensors.truncated"). main() prints the sentence and exits with 1, or 2 for "usage.*".

struct Error : std::runtime_error {
    std::string id;
    Error(std::string error_id, const std::string& sentence) : std::runtime_error(sentence), id(std::move(error_id)) {}
};

// Formats like printf; a sentence of any length.
[[noreturn]] [[gnu::format(printf, 2, 3)]] inline void fail(const char* id, const char* format, ...) {
    va_list arguments, again;
    va_start(arguments, format);
    va_copy(again, arguments);
    std::string sentence(static_cast<size_t>(std::vsnprintf(nullptr, 0, format, arguments)), '\0');
    std::vsnprintf(sentence.data(), sentence.size() + 1, format, again);
    va_end(again);
    va_end(arguments);
    throw Error(id, sentence);
}

// ---------------------------------------------------------------------------------------------------------------------
// Random numbers by counter: a value is a function of (seed, stream, step, site, index) and of nothing else, so no order
// of evaluation, number of threads or interruption can change it, and there is no generator state to save.

using Words4 = std::array<uint32_t, 4>;

// Philox4x32-10. Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011, section 3.3.
inline Words4 philox(Words4 counter, uint32_t key0, uint32_t key1) {
    for (int round = 0; round < 10; ++round) {
        const uint64_t product0 = uint64_t{0xD2511F53} * counter[0];
        const uint64_t product1 = uint64_t{0xCD9E8D57} * counter[2];
        counter = {static_cast<uint32_t>(product1 >> 32) ^ counter[1] ^ key0, static_cast<uint32_t>(product1),
                   static_cast<uint32_t>(product0 >> 32) ^ counter[3] ^ key1, static_cast<uint32_t>(product0)};
        key0 += 0x9E3779B9;  // golden ratio
        key1 += 0xBB67AE85;  // sqrt(3) - 1
    }
    return counter;
}

// Each use of chance has its own stream: switching one feature on or off moves no other's numbers. The values are part
// of the format of a run (a porter needs them); never renumber.
enum class Stream : uint32_t {
    initialisation = 1,     // step: tensor number; index: element
    dropout = 2,            // step: update; site: place in the network; index: element
    batch = 3,              // step: update; index: window of the batch
    exploration = 4,        // step: online episode; site: action dimension; index: time-step
    remembered_action = 5,  // eq. (6). step: update; index: position in the batch
    entropy_noise = 6,      // step: update; site: action dimension; index: position in the batch
    environment = 7,        // step: episode; index: draw within the reset
    projection = 8,         // step: 0; index: element of the random projection
    data_set = 9,           // step: trajectory; index: time-step
};

struct Random {
    uint32_t seed;
    Stream stream;

    // 128 random bits. Counter = (index, site, step low, step high), key = (seed, stream).
    Words4 words(uint64_t step, uint32_t index, uint32_t site = 0) const {
        return philox({index, site, static_cast<uint32_t>(step), static_cast<uint32_t>(step >> 32)}, seed,
                      static_cast<uint32_t>(stream));
    }

    // Uniform in [0, 1), a multiple of 2^-53.
    double uniform(uint64_t step, uint32_t index, uint32_t site = 0) const {
        const Words4 w = words(step, index, site);
        return static_cast<double>(((uint64_t{w[1]} << 32) | w[0]) >> 11) * 0x1p-53;
    }

    // Uniform integer in [0, bound), bound > 0: the high half of a 64 x 64 bit product; bias below bound / 2^64.
    uint64_t below(uint64_t bound, uint64_t step, uint32_t index, uint32_t site = 0) const {
        const Words4 w = words(step, index, site);
        __extension__ using uint128 = unsigned __int128;
        return static_cast<uint64_t>((static_cast<uint128>((uint64_t{w[1]} << 32) | w[0]) * bound) >> 64);
    }

    // Standard normal by Box and Muller, from words 2 and 3. The float functions of libm give the same bits on every
    // x86 processor, the double ones do not; 24 bits reach 5.8 standard deviations.
    float normal(uint64_t step, uint32_t index, uint32_t site = 0) const {
        const Words4 w = words(step, index, site);
        const float u = (static_cast<float>(w[2] >> 8) + 1.0f) * 0x1p-24f;  // (0, 1]
        const float angle = static_cast<float>(w[3] >> 8) * (0x1p-24f * 6.2831853f);
        return std::sqrt(-2.0f * std::log(u)) * std::cos(angle);
    }
};
