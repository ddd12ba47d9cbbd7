// test.hpp: the whole test runner. A test is a named sentence; a check that does not hold prints where and what.
//   TEST(lookup_prefers_older_entry_on_tie) { CHECK(...); CHECK_EQUAL(got, expected); CHECK_CLOSE(got, expected,
//   bound); } CHECK_FAILS("safetensors.truncated", parse(bytes));   // the statement must throw Error with this id
// Random parts draw from test_seed(), which main prints and `build/tests --seed N` gives back.
#pragma once

#include <unistd.h>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <exception>
#include <fstream>
#include <functional>
#include <sstream>
#include <string>
#include <vector>

#include "../nn.hpp"

struct Test {
    const char* name;
    const char* file;
    void (*run)();
};

inline std::vector<Test>& all_tests() {
    static std::vector<Test> tests;
    return tests;
}
inline uint32_t& test_seed() {
    static uint32_t seed = 1;
    return seed;
}
inline int& failed_checks() {
    static int count = 0;
    return count;
}
inline bool add_test(Test test) { return all_tests().push_back(test), true; }

// Returns what f() prints, on stdout (which main makes line by line) and on stderr.
inline std::string printed(const std::function<void()>& f) {
    char path[] = "/tmp/wodtem-test-XXXXXX";
    const int file = ::mkstemp(path), out = ::dup(1), err = ::dup(2);
    std::fflush(stdout);
    ::dup2(file, 1), ::dup2(file, 2);
    std::exception_ptr problem;
    try {
        f();
    } catch (...) {
        problem = std::current_exception();
    }
    std::fflush(stdout);
    ::dup2(out, 1), ::dup2(err, 2);
    for (const int each : {file, out, err}) ::close(each);
    std::ostringstream text;
    text << std::ifstream(path).rdbuf();
    ::unlink(path);
    if (problem) std::rethrow_exception(problem);
    return text.str();
}

// Prints at most 20 failures of one test: a broken kernel fails in every element.
inline void report_failure(const char* file, int line, const std::string& what) {
    if (++failed_checks() <= 20) std::printf("  %s:%d: %s\n", file, line, what.c_str());
}

template <class T>
std::string shown(const T& value) {
    std::ostringstream out;
    out.precision(17);
    out << value;
    return out.str();
}

template <class A, class B>
void check_equal(const char* file, int line, const char* text, const A& got, const B& expected) {
    if (!(got == expected))
        report_failure(file, line, std::string(text) + ": got " + shown(got) + ", expected " + shown(expected));
}

// |got - expected| <= bound, absolute; NaN never passes.
inline void check_close(const char* file, int line, const char* text, double got, double expected, double bound) {
    if (!(std::fabs(got - expected) <= bound))
        report_failure(
            file, line,
            std::string(text) + ": got " + shown(got) + ", expected " + shown(expected) + " within " + shown(bound));
}

inline void check_fails(const char* file, int line, const std::string& id, const std::function<void()>& statement) {
    try {
        statement();
        report_failure(file, line, "expected the error " + id + ", nothing was thrown");
    } catch (const Error& error) {
        if (error.id != id)
            report_failure(file, line, "expected the error " + id + ", got " + error.id + ": " + error.what());
    }
}

#define TEST(name)                                                      \
    static void name();                                                 \
    static const bool name##_added = add_test({#name, __FILE__, name}); \
    static void name()
#define CHECK(condition)                                                                    \
    do {                                                                                    \
        if (!(condition)) report_failure(__FILE__, __LINE__, "does not hold: " #condition); \
    } while (false)
#define CHECK_EQUAL(got, expected) check_equal(__FILE__, __LINE__, #got, got, expected)
#define CHECK_CLOSE(got, expected, bound) check_close(__FILE__, __LINE__, #got, got, expected, bound)
#define CHECK_FAILS(id, ...) check_fails(__FILE__, __LINE__, id, [&] { __VA_ARGS__; })
