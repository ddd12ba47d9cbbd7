// main.cpp: runs every test, or those whose name contains an argument; --part 2/3: of these the second, fifth, ...
//   build/tests [--seed N] [--part K/N] [part-of-a-name ...]
#include <cstdlib>
#include <cstring>

#include "test.hpp"

int main(int argument_count, char** arguments) {
    std::vector<const char*> wanted;
    unsigned part = 1, parts = 1, chosen = 0;
    for (int i = 1; i < argument_count; ++i) {
        if (std::strcmp(arguments[i], "--seed") == 0 && i + 1 < argument_count)
            test_seed() = static_cast<uint32_t>(std::strtoul(arguments[++i], nullptr, 10));
        else if (std::strcmp(arguments[i], "--part") == 0 && i + 1 < argument_count) {
            if (std::sscanf(arguments[++i], "%u/%u", &part, &parts) != 2 || part < 1 || part > parts)
                return std::printf("--part takes K/N, 1 <= K <= N; got %s\n", arguments[i]), 2;
        } else
            wanted.push_back(arguments[i]);
    }
    std::setvbuf(stdout, nullptr, _IOLBF, 0);
    std::printf("seed %u (give it back with: build/tests --seed %u)\n", test_seed(), test_seed());
    int passed = 0, failed = 0;
    for (const Test& test : all_tests()) {
        bool run = wanted.empty();
        for (const char* text : wanted) run = run || std::strstr(test.name, text) != nullptr;
        if (!run || chosen++ % parts != part - 1) continue;
        failed_checks() = 0;
        try {
            test.run();
        } catch (const std::exception& error) {
            report_failure(test.file, 0, std::string("stopped by an exception: ") + error.what());
        }
        std::printf("%s %s\n", failed_checks() == 0 ? "ok    " : "FAILED", test.name);
        ++(failed_checks() == 0 ? passed : failed);
    }
    std::printf("%d passed, %d failed\n", passed, failed);
    return failed == 0 && passed > 0 ? 0 : 1;
}
