// console.hpp: what a person sees of a long command, on stderr: a bar on a terminal, elsewhere a line for each tenth of
// the way; and the request to stop.
#pragma once

#include <sys/ioctl.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <csignal>
#include <cstdio>
#include <string>
#include <string_view>

using Clock = std::chrono::steady_clock;

inline double seconds_since(Clock::time_point at) { return std::chrono::duration<double>(Clock::now() - at).count(); }

// 75 seconds are 1:15, 3675 are 1:01:15.
inline std::string clock_text(double seconds) {
    const int whole = static_cast<int>(std::clamp(seconds, 0.0, 3599999.0));
    const std::string hours = whole >= 3600 ? std::to_string(whole / 3600) + ":" : "";
    char text[32];
    std::snprintf(text, sizeof text, hours.empty() ? "%d:%02d" : "%02d:%02d", whole / 60 % 60, whole % 60);
    return hours + text;
}

// Set by SIGINT, SIGTERM and SIGHUP: a long command then saves its state and ends. A signal handler can reach nothing
// but a global variable; this is the only one.
inline volatile std::sig_atomic_t stop_requested = 0;

inline constexpr std::array stop_signals = {SIGINT, SIGTERM, SIGHUP};
using SignalHandler = void (*)(int);

// Installs a handler for all of them, but for SIGHUP where it is ignored: that is nohup. Returns the handlers before.
inline std::array<SignalHandler, 3> handle_stop_signals(SignalHandler handler) {
    std::array<SignalHandler, 3> before;
    for (size_t i = 0; i < before.size(); ++i) {
        before[i] = std::signal(stop_signals[i], handler);
        if (stop_signals[i] == SIGHUP && before[i] == SIG_IGN) std::signal(SIGHUP, SIG_IGN);
    }
    return before;
}

// From now on a signal asks to stop; the same one again ends the process at once.
inline void stop_on_signals() {
    handle_stop_signals([](int number) {
        stop_requested = 1;
        std::signal(number, SIG_DFL);
    });
}

inline constexpr std::string_view nothing_to_save =
    "stopped before there was anything new to save; the same command starts again";

// While one lives, a signal ends the process at once, with this sentence: nothing is lost by it.
struct StopAtOnce {
    const std::array<SignalHandler, 3> before = handle_stop_signals([](int) {
        for (const std::string_view text : {std::string_view("wodtem: "), nothing_to_save, std::string_view("\n")})
            if (::write(STDERR_FILENO, text.data(), text.size()) < 0) break;
        ::_exit(1);
    });
    ~StopAtOnce() {
        for (size_t i = 0; i < before.size(); ++i) std::signal(stop_signals[i], before[i]);
    }
};

struct Console {
    const bool terminal = isatty(STDERR_FILENO) != 0;
    std::string label = "";  // begins each line
    std::string phase = "";  // of the latest line
    Clock::time_point phase_began = Clock::now();
    Clock::time_point shown = phase_began - std::chrono::hours(1);
    double first_share = 0;  // of the phase, when this process began it
    int tenth = -1;          // of the phase, at the latest line

    // share: how much of the phase is done, 0 to 1. later: seconds expected after the phase. details(): the line's end,
    // called only when a line is drawn.
    void show(const std::string& new_phase, double share, double later, auto&& details) {
        if (phase != new_phase) {
            phase = new_phase;
            phase_began = Clock::now();
            first_share = share;
            tenth = -1;
        }
        const int new_tenth = static_cast<int>(share * 10);
        const bool too_soon = terminal ? seconds_since(shown) < 0.1 && share < 1 : new_tenth == tenth;
        if (too_soon) return;
        shown = Clock::now();
        tenth = new_tenth;
        draw(share, later, details());
    }

    void draw(double share, double later, const std::string& details) const {
        std::string text = label + ", " + phase + " " + bar(share);
        if (share > first_share && (share < 1 || later > 0)) {
            const double left = seconds_since(phase_began) / (share - first_share) * (1 - share);
            text += " " + clock_text(left + later) + " left,";
        }
        text += " " + details;
        if (!terminal) {
            std::fprintf(stderr, "%s\n", text.c_str());
            return;
        }
        text.resize(std::min(text.size(), columns() - 1));  // a line that wraps cannot be drawn over
        std::fprintf(stderr, "\r%s\033[K%s", text.c_str(), share >= 1 ? "\n" : "");
    }

    std::string bar(double share) const {
        const size_t width = 12, filled = static_cast<size_t>(share * static_cast<double>(width));
        char percent[16];
        std::snprintf(percent, sizeof percent, "%3.0f%%", 100 * share);
        return terminal ? "[" + std::string(filled, '#') + std::string(width - filled, '.') + "]" + percent : percent;
    }

    static size_t columns() {
        winsize size{};
        return ioctl(STDERR_FILENO, TIOCGWINSZ, &size) == 0 && size.ws_col > 20 ? size.ws_col : 80;
    }

    // Leaves the bar's line before something else is printed.
    void end_line() const {
        if (terminal) std::fprintf(stderr, "\n");
    }
};
