// figures.hpp: figures as SVG text, the report page as one HTML file, and the small tables between them and CSV.
//
//   +---------------------------------------+   720 units wide and set in type of 13 and more, so that it can be read at
//   | title                                 |   half that width. Colours: Okabe and Ito's, distinct to colour-blind eyes;
//   | y |  grid, bands, lines or bars       |   the background is painted, so that figures read on dark pages too.
//   |   +---------------------------------  |   The legend has its own rows below the plot: it never covers data.
//   |      x ticks, x label, legend rows    |
//   +---------------------------------------+
//
// Promises: equal data give equal text in every locale; no scripts, fonts or other files are needed; any text is
// escaped; NaN breaks a line or leaves a bar out and is never written as a coordinate.
// Leaves out: knowledge of what is drawn (labels come from the caller, in UTF-8), interaction, exact text widths.
#pragma once

#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <iterator>
#include <limits>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "../nn.hpp"

// ---------------------------------------------------------------------------------------------------------------------
// What to draw

// Fixed by the caller: one method, one colour.
enum class Colour { blue, vermillion, green, purple, orange, sky, black };

struct Series {
    std::string label;
    Colour colour;
    std::vector<double> x, mean, deviation;  // deviation: half the height of the band, or empty
};
struct Reference {  // a dashed horizontal line
    std::string label;
    Colour colour;
    double value;
};
struct LineChart {
    std::string title, x_label, y_label;  // labels with units
    std::vector<Series> series;
    std::vector<Reference> references;
    bool log_y = false;      // values that are not positive are left out
    double y_floor = -1e30;  // no value can lie below: bands are cut there
    bool cut_x = false;      // the x axis ends with the data, not at the next tick
};

struct Bars {
    std::string label;
    Colour colour;
    std::vector<double> values, deviation;  // one per category; deviation: an error bar of twice this, or empty
};
struct BarChart {
    std::string title, x_label, y_label;
    std::vector<std::string> categories;
    std::vector<Bars> series;
};

struct Cell {
    int row, column;
};
struct Arrow {
    int drow, dcolumn;  // -1, 0 or 1; both 0: no arrow
    double probability;
};
struct GridPolicy {
    std::string title;
    int rows, columns;
    std::vector<Arrow> arrows;  // (rows, columns): the most likely action of each cell; row 0 on top
    Cell start, goal;
    std::vector<Cell> path;
};

struct Place {
    double row, column;  // whole numbers: the middle of a cell
};
struct MazePath {
    Place goal;
    std::vector<Place> places;  // from the start to the end
};
struct MazePaths {
    std::string title, map;  // map: rows from the top, each ended by a slash; 1: wall, all else is free
    double goal_radius;      // cells
    std::string goal_label;
    std::vector<MazePath> paths;
};

struct Table {
    std::vector<std::string> header;
    std::vector<std::vector<std::string>> rows;
};
struct Figure {
    std::string svg, caption;
};
struct Section {
    std::string heading;
    std::vector<std::string> paragraphs;
    std::vector<Table> tables;
    std::vector<Figure> figures;
};

// ---------------------------------------------------------------------------------------------------------------------
// Marks

namespace svg {

inline constexpr const char* colours[] = {"#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000"};
inline constexpr const char *ink = "#222222", *faint_ink = "#555555", *grid = "#E2E2E2";
inline constexpr double width = 720, plot_height = 300;

inline const char* hex(Colour colour) { return colours[static_cast<size_t>(colour)]; }

// Neither NaN nor beyond what single precision can take the logarithm of.
inline bool drawable(double value) { return std::fabs(value) < 1e30; }

// A coordinate: at most two digits after the point, trailing zeros dropped; never "-0".
inline std::string number(double value) {
    char text[64];  // 1e30 has 31 digits
    std::string out(text, std::to_chars(text, std::end(text), value, std::chars_format::fixed, 2).ptr);
    out.erase(out.find_last_not_of('0') + 1);
    if (out.back() == '.') out.pop_back();
    return out == "-0" ? "0" : out;
}

// For XML and HTML, in text and in attributes. Control characters have no place in XML 1.0.
inline std::string escaped(std::string_view text) {
    std::string out;
    for (const char c : text) {
        if (c == '&')
            out += "&amp;";
        else if (c == '<')
            out += "&lt;";
        else if (c == '>')
            out += "&gt;";
        else if (c == '"')
            out += "&quot;";
        else
            out += (c >= 0 && c < 0x20 && c != '\n' && c != '\t') ? '?' : c;
    }
    return out;
}

// name="value" pairs of coordinates, to two decimals.
inline std::string attributes(std::initializer_list<std::pair<const char*, double>> pairs) {
    std::string out;
    for (const auto& [name, value] : pairs) out += std::string(" ") + name + "=\"" + number(value) + "\"";
    return out;
}

inline std::string rectangle(double x, double y, double w, double h, const std::string& style) {
    return "<rect" + attributes({{"x", x}, {"y", y}, {"width", w}, {"height", h}}) + " " + style + "/>\n";
}

inline std::string line(double x1, double y1, double x2, double y2, const std::string& style) {
    return "<line" + attributes({{"x1", x1}, {"y1", y1}, {"x2", x2}, {"y2", y2}}) + " " + style + "/>\n";
}

inline std::string text(double x, double y, std::string_view content, const std::string& style) {
    return "<text" + attributes({{"x", x}, {"y", y}}) + " " + style + ">" + escaped(content) + "</text>\n";
}

inline std::string stroke(const char* colour, double thickness) {
    return std::string("fill=\"none\" stroke=\"") + colour + "\" stroke-width=\"" + number(thickness) + "\"";
}

// A guess, on the wide side: there is no font to ask.
inline double text_width(std::string_view content, double size) {
    double em = 0;
    for (const char c : content)
        if ((c & 0xC0) != 0x80) em += c >= 'A' && c <= 'Z' ? 0.76 : 0.61;  // once per UTF-8 character
    return em * size;
}

inline std::string open(double w, double h, const std::string& title) {
    return "<svg xmlns=\"http://www.w3.org/2000/svg\"" + attributes({{"width", w}, {"height", h}}) + " viewBox=\"0 0 " +
           number(w) + " " + number(h) + "\" role=\"img\" aria-label=\"" + escaped(title) +
           "\" font-family=\"sans-serif\" font-size=\"13\" fill=\"" + ink + "\">\n" +
           rectangle(0, 0, w, h, "fill=\"#FFFFFF\"") + text(16, 30, title, "font-size=\"17\" font-weight=\"bold\"");
}

// ---------------------------------------------------------------------------------------------------------------------
// Axes

// 20000 -> "20,000"; -0.5 -> the same with a true minus sign; very large and very small in scientific notation.
inline std::string tick_text(double value, int decimals) {
    char text[64];
    const double size = std::fabs(value);
    const bool scientific = size >= 1e7 || decimals > 6;
    const auto end = scientific ? std::to_chars(text, std::end(text), size, std::chars_format::general, 6)
                                : std::to_chars(text, std::end(text), size, std::chars_format::fixed, decimals);
    std::string out(text, end.ptr);
    if (!scientific)
        for (size_t i = std::min(out.find('.'), out.size()); i > 3; i -= 3) out.insert(i - 3, ",");
    return value == 0 ? "0" : value < 0 ? "\u2212" + out : out;
}

// Digits after the point that a multiple of `step` needs, for a step of 1, 2 or 5 times a power of ten.
inline int decimals_for(double step) {
    int decimals = 0;
    for (double unit = 1; unit > step * 1.0001 && decimals < 12; unit /= 10) ++decimals;
    return decimals;
}

struct Axis {
    double low = 0, high = 1, from = 0, to = 1;  // values low..high lie at from..to
    bool log = false;
    std::vector<double> ticks;
    double step = 0;  // between ticks; 0: they differ, as on a logarithmic axis

    // The float logarithm gives the same bits on every processor, the double one does not.
    double place(double value) const { return log ? double{std::log(static_cast<float>(value))} : value; }
    double at(double value) const {
        const double v = std::clamp(value, low, high);
        return from + (to - from) * (place(v) - place(low)) / (place(high) - place(low));
    }
    std::string label(double tick) const { return tick_text(tick, decimals_for(step > 0 ? step : tick)); }
};

// The largest power of ten that is not above `value` > 0.
inline double decade(double value) {
    double power = 1;
    while (power * 10 <= value) power *= 10;
    while (power > value) power /= 10;
    return power;
}

// About `count` steps of 1, 2 or 5 times a power of ten, both ends on a tick. Starts at 0 if less than half is wasted.
inline Axis linear_axis(double low, double high, int count) {
    if (!(low <= high)) low = 0, high = 1;  // nothing to show
    if (low > 0 && low <= 0.5 * high) low = 0;
    const double size = std::max(std::fabs(low), std::fabs(high)), margin = 0.5 * decade(size > 1e-30 ? size : 1);
    if (high - low < 1e-9 * size + 1e-30) low -= margin, high += margin;  // one value; also, i below must stay exact
    const double rough = (high - low) / count, power = decade(rough), r = rough / power;
    Axis axis;
    axis.step = power * (r < 1.5 ? 1 : r < 3 ? 2 : r < 7 ? 5 : 10);
    const double first = std::floor(low / axis.step + 1e-9), last = std::ceil(high / axis.step - 1e-9);
    for (double i = first; i <= last; ++i) axis.ticks.push_back(i * axis.step);
    axis.low = axis.ticks.front(), axis.high = axis.ticks.back();
    return axis;
}

// 0 < low. Ticks at 1, 2 and 5 times the powers of ten; beyond three decades at the powers alone; below a factor of
// five as on a linear axis.
inline Axis log_axis(double low, double high) {
    if (!(low <= high)) low = 1, high = 10;
    Axis axis = linear_axis(low / 1.1, high * 1.1, 5);
    axis.log = true, axis.low = low / 1.1, axis.high = high * 1.1;
    if (high > 5 * low) {
        axis.ticks.clear(), axis.step = 0;
        for (double power = decade(axis.low); power <= axis.high; power *= 10)
            for (const double factor : {1.0, 2.0, 5.0})
                if (factor == 1 || high < 1000 * low) axis.ticks.push_back(factor * power);
    }
    std::erase_if(axis.ticks, [&](double tick) { return tick < axis.low || tick > axis.high; });
    return axis;
}

// ---------------------------------------------------------------------------------------------------------------------
// The frame that line and bar charts share

struct Key {  // one entry of a legend
    std::string label;
    Colour colour;
    enum Mark { solid, dashed, box } mark;
};

inline constexpr const char* dashes = " stroke-dasharray=\"7 5\"";

// Entries from left to right, in as many rows of 22 as they need. Returns the y below the last row.
inline double legend(std::string& out, const std::vector<Key>& keys, double left, double y) {
    double x = left;
    for (const Key& key : keys) {
        if (key.label.empty()) continue;  // a single series explains itself
        const double w = 34 + text_width(key.label, 13) + 18;
        if (x > left && x + w - 18 > width - 10) x = left, y += 22;
        out += key.mark == Key::box
                   ? rectangle(x + 6, y - 7, 14, 14, std::string("fill=\"") + hex(key.colour) + "\"")
                   : line(x, y, x + 26, y, stroke(hex(key.colour), 2.5) + (key.mark == Key::dashed ? dashes : ""));
        out += text(x + 34, y + 4.5, key.label, "");
        x += w;
    }
    return y + 22;
}

struct Frame {
    std::string marks;                // what has been drawn
    double left, right, top, bottom;  // of the plot
    double end = 0;                   // of the tick labels below it
};

// Horizontal grid lines with their labels and the y label; fixes where `y` lies.
inline Frame open_frame(Axis& y, const std::string& y_label) {
    double widest = 0;
    for (const double tick : y.ticks) widest = std::max(widest, text_width(y.label(tick), 13));
    Frame frame{"", 50 + widest, width - 40, 50, 50 + plot_height};
    y.from = frame.bottom, y.to = frame.top;
    for (const double tick : y.ticks) {
        frame.marks += line(frame.left, y.at(tick), frame.right, y.at(tick), stroke(grid, 1));
        frame.marks += text(frame.left - 8, y.at(tick) + 4.5, y.label(tick), "text-anchor=\"end\"");
    }
    const std::string middle = number((frame.top + frame.bottom) / 2);
    frame.marks +=
        text(0, 0, y_label,
             "text-anchor=\"middle\" font-size=\"14\" transform=\"translate(24 " + middle + ") rotate(-90)\"");
    return frame;
}

// The x label and the legend, then the whole figure: only now is its height known.
inline std::string close_frame(Frame& frame, const std::string& title, const std::string& x_label,
                               const std::vector<Key>& keys) {
    const double y = frame.end + 24;
    frame.marks += line(frame.left, frame.bottom, frame.right, frame.bottom, stroke(faint_ink, 1.2));
    frame.marks += text((frame.left + frame.right) / 2, y, x_label, "text-anchor=\"middle\" font-size=\"14\"");
    const double height = legend(frame.marks, keys, 16, y + 26);
    return open(width, height, title) + frame.marks + "</svg>\n";
}

inline void check_length(size_t got, size_t expected, const std::string& label, const std::string& title) {
    if (got != expected)
        fail("figure.length", "figure \"%s\": \"%s\" has %zu values, expected %zu", title.c_str(), label.c_str(), got,
             expected);
}

// deviation[i], or 0 if there is none.
inline double spread(const std::vector<double>& deviation, size_t i) {
    return deviation.empty() || !drawable(deviation[i]) ? 0 : deviation[i];
}

}  // namespace svg

// ---------------------------------------------------------------------------------------------------------------------
// Charts

inline std::string line_chart(const LineChart& chart) {
    const auto shown = [&](double value) { return svg::drawable(value) && (!chart.log_y || value > 1e-30); };
    constexpr double none = std::numeric_limits<double>::infinity();
    double x_low = none, x_high = -none, y_low = none, y_high = -none;
    const auto include = [&](double value) {
        if (shown(value)) y_low = std::min(y_low, std::max(value, chart.y_floor)), y_high = std::max(y_high, value);
    };
    for (const Series& s : chart.series) {
        svg::check_length(s.mean.size(), s.x.size(), s.label, chart.title);
        if (!s.deviation.empty()) svg::check_length(s.deviation.size(), s.x.size(), s.label, chart.title);
        for (size_t i = 0; i < s.x.size(); ++i) {
            if (!svg::drawable(s.x[i]) || !shown(s.mean[i])) continue;
            x_low = std::min(x_low, s.x[i]), x_high = std::max(x_high, s.x[i]);
            const double spread = svg::spread(s.deviation, i);
            for (const double edge : {-spread, 0.0, spread}) include(s.mean[i] + edge);
        }
    }
    for (const Reference& r : chart.references) include(r.value);

    svg::Axis y = chart.log_y ? svg::log_axis(y_low, y_high) : svg::linear_axis(y_low, y_high, 5);
    svg::Axis x = svg::linear_axis(x_low, x_high, 6);
    if (chart.cut_x && x_low < x_high) {
        x.high = x_high;
        std::erase_if(x.ticks, [&](double tick) { return tick > x_high; });
    }
    svg::Frame frame = svg::open_frame(y, chart.y_label);
    x.from = frame.left, x.to = frame.right, frame.end = frame.bottom + 22;
    for (const double tick : x.ticks) {
        frame.marks +=
            svg::line(x.at(tick), frame.bottom, x.at(tick), frame.bottom + 5, svg::stroke(svg::faint_ink, 1.2));
        frame.marks += svg::text(x.at(tick), frame.end, x.label(tick), "text-anchor=\"middle\"");
    }

    std::string bands, lines;  // bands lie below all lines
    std::vector<svg::Key> keys;
    const auto point = [&](double px, double py) { return svg::number(x.at(px)) + " " + svg::number(y.at(py)) + " "; };
    for (const Series& s : chart.series) {
        keys.push_back({s.label, s.colour, svg::Key::solid});
        for (size_t begin = 0, end = 0; begin < s.x.size(); begin = end + 1) {  // one run without NaN: begin..end-1
            for (end = begin; end < s.x.size() && svg::drawable(s.x[end]) && shown(s.mean[end]);) ++end;
            if (begin == end) continue;
            std::string path, upper, lower;
            for (size_t i = begin; i < end; ++i) {
                path += point(s.x[i], s.mean[i]);
                upper += point(s.x[i], s.mean[i] + svg::spread(s.deviation, i));
                lower = point(s.x[i], s.mean[i] - svg::spread(s.deviation, i)) + lower;
            }
            const std::string colour = svg::hex(s.colour);
            if (!s.deviation.empty())
                bands += "<polygon points=\"" + upper + lower + "\" fill=\"" + colour + "\" fill-opacity=\"0.18\"/>\n";
            lines +=
                "<path d=\"M " + path + "\" " + svg::stroke(colour.c_str(), 2.5) + " stroke-linejoin=\"round\"/>\n";
            if (begin + 1 == end)  // a path of one point would be invisible
                lines += "<circle" +
                         svg::attributes({{"cx", x.at(s.x[begin])}, {"cy", y.at(s.mean[begin])}, {"r", 3}}) +
                         " fill=\"" + colour + "\"/>\n";
        }
    }
    for (const Reference& r : chart.references) {
        if (!shown(r.value)) continue;
        keys.push_back({r.label, r.colour, svg::Key::dashed});
        lines += svg::line(frame.left, y.at(r.value), frame.right, y.at(r.value),
                           svg::stroke(svg::hex(r.colour), 2) + svg::dashes);  // on top: a line below shows in the gaps
    }
    frame.marks += bands + lines;
    return svg::close_frame(frame, chart.title, chart.x_label, keys);
}

// Labels below `slot` wide places: flat if they fit, else slanted, else only each so-many-th. Returns where they end.
inline double category_labels(std::string& marks, const std::vector<std::string>& labels, double left, double slot,
                              double y) {
    double widest = 0;
    for (const std::string& label : labels) widest = std::max(widest, svg::text_width(label, 13));
    const bool slanted = widest + 8 > slot && slot >= 18;
    size_t stride = 1;
    for (const size_t wider : {2, 5, 10, 20, 50, 100, 200, 500, 1000})
        if (!slanted && static_cast<double>(stride) * slot < widest + 8) stride = wider;
    for (size_t i = 0; i < labels.size(); i += stride) {
        const double x = left + slot * (static_cast<double>(i) + 0.5);
        const std::string turn = " transform=\"rotate(-45 " + svg::number(x + 4) + " " + svg::number(y + 14) + ")\"";
        marks += slanted ? svg::text(x + 4, y + 14, labels[i], "text-anchor=\"end\"" + turn)
                         : svg::text(x, y + 20, labels[i], "text-anchor=\"middle\"");
    }
    return slanted ? y + 14 + 0.71 * widest : y + 22;
}

inline std::string bar_chart(const BarChart& chart) {
    double low = 0, high = 0;
    for (const Bars& s : chart.series) {
        svg::check_length(s.values.size(), chart.categories.size(), s.label, chart.title);
        if (!s.deviation.empty()) svg::check_length(s.deviation.size(), chart.categories.size(), s.label, chart.title);
        for (size_t i = 0; i < s.values.size(); ++i) {
            if (!svg::drawable(s.values[i])) continue;
            const double spread = svg::spread(s.deviation, i);
            low = std::min(low, s.values[i] < 0 ? s.values[i] - spread : 0);
            high = std::max(high, s.values[i] + spread);
        }
    }
    svg::Axis y = svg::linear_axis(low, high > low ? high : 1, 5);
    svg::Frame frame = svg::open_frame(y, chart.y_label);
    const double slot = (frame.right - frame.left) / std::max(1.0, static_cast<double>(chart.categories.size()));
    const double group = 0.8 * slot, bar = group / std::max(1.0, static_cast<double>(chart.series.size()));
    std::vector<svg::Key> keys;
    for (size_t k = 0; k < chart.series.size(); ++k) {
        const Bars& s = chart.series[k];
        keys.push_back({s.label, s.colour, svg::Key::box});
        for (size_t i = 0; i < s.values.size(); ++i) {
            if (!svg::drawable(s.values[i])) continue;
            const double x = frame.left + slot * (static_cast<double>(i) + 0.1) + bar * static_cast<double>(k);
            const double a = y.at(0), b = y.at(s.values[i]);
            frame.marks += svg::rectangle(x, std::min(a, b), 0.92 * bar, std::fabs(a - b),
                                          std::string("fill=\"") + svg::hex(s.colour) + "\"");
            const double spread = svg::spread(s.deviation, i);
            if (spread > 0)
                frame.marks += svg::line(x + 0.46 * bar, y.at(s.values[i] + spread), x + 0.46 * bar,
                                         y.at(s.values[i] - spread), svg::stroke(svg::ink, 1.5));
        }
    }
    if (low < 0) frame.marks += svg::line(frame.left, y.at(0), frame.right, y.at(0), svg::stroke(svg::faint_ink, 1.2));
    frame.end = category_labels(frame.marks, chart.categories, frame.left, slot, frame.bottom);
    return svg::close_frame(frame, chart.title, chart.x_label, keys);
}

// An arrow centred at (x, y), longer and darker the more probable; `size` is the side of a cell.
inline std::string arrow_mark(double x, double y, const Arrow& arrow, double size, const char* colour) {
    const double norm = std::sqrt(static_cast<double>(arrow.drow * arrow.drow + arrow.dcolumn * arrow.dcolumn));
    const double p = std::clamp(arrow.probability, 0.0, 1.0), ux = arrow.dcolumn / norm, uy = arrow.drow / norm;
    const double half = size * (0.14 + 0.2 * p), head = 0.13 * size;
    const double tip_x = x + ux * half, tip_y = y + uy * half, neck_x = tip_x - ux * head, neck_y = tip_y - uy * head;
    std::string out = "<g opacity=\"" + svg::number(0.35 + 0.65 * p) + "\">";
    out += svg::line(x - ux * half, y - uy * half, neck_x, neck_y, svg::stroke(colour, 0.045 * size));
    out += "<polygon points=\"" + svg::number(tip_x) + " " + svg::number(tip_y);
    for (const double side : {0.6, -0.6})
        out += " " + svg::number(neck_x - uy * head * side) + " " + svg::number(neck_y + ux * head * side);
    return out + "\" fill=\"" + colour + "\"/></g>\n";
}

// Rows at the left, columns on top, from 0; `size` is the side of a cell.
inline std::string cell_numbers(double left, double top, double size, int rows, int columns) {
    std::string out;
    for (int row = 0; row < rows; ++row)
        out += svg::text(left - 10, top + size * (row + 0.5) + 4.5, std::to_string(row), "text-anchor=\"end\"");
    for (int column = 0; column < columns; ++column)
        out += svg::text(left + size * (column + 0.5), top - 9, std::to_string(column), "text-anchor=\"middle\"");
    return out;
}

inline std::string grid_policy(const GridPolicy& policy) {
    svg::check_length(policy.arrows.size(), static_cast<size_t>(policy.rows * policy.columns), "arrows", policy.title);
    const double size = 480.0 / std::max({policy.rows, policy.columns, 1}), left = 48, top = 76;
    const double right = left + size * policy.columns, bottom = top + size * policy.rows;
    std::string marks;
    const auto on_path = [&](int row, int column) {
        return std::any_of(policy.path.begin(), policy.path.end(),
                           [&](Cell c) { return c.row == row && c.column == column; });
    };
    const auto badge = [&](Cell cell, const char* letter, const char* colour) {
        const double x = left + size * cell.column + 14, y = top + size * cell.row + 14;
        marks += "<circle" + svg::attributes({{"cx", x}, {"cy", y}, {"r", 11}}) + " fill=\"" + colour + "\"/>";
        marks += svg::text(x, y + 5, letter,
                           "text-anchor=\"middle\" font-weight=\"bold\" font-size=\"14\" style=\"fill:#FFFFFF\"");
    };
    for (int row = 0; row < policy.rows; ++row) {
        for (int column = 0; column < policy.columns; ++column) {
            const double x = left + size * column, y = top + size * row;
            const bool blue = on_path(row, column);
            marks += svg::rectangle(
                x, y, size, size, std::string(blue ? "fill=\"#B9DAEF\"" : "fill=\"#FFFFFF\"") + " stroke=\"#B0B0B0\"");
            const Arrow& arrow = policy.arrows[static_cast<size_t>(row * policy.columns + column)];
            if ((arrow.drow != 0 || arrow.dcolumn != 0) && svg::drawable(arrow.probability))
                marks += arrow_mark(x + size / 2, y + size / 2, arrow, size, svg::ink);
        }
    }
    marks += cell_numbers(left, top, size, policy.rows, policy.columns);
    badge(policy.start, "S", svg::hex(Colour::black));
    badge(policy.goal, "G", svg::hex(Colour::vermillion));

    double y = bottom + 28;
    marks += svg::rectangle(left, y - 8, 16, 16, "fill=\"#B9DAEF\" stroke=\"#B0B0B0\"");
    marks += svg::text(left + 24, y + 4.5, "cells on the greedy path", "");
    marks += svg::text(left, y + 34.5, "most likely action, probability", "");
    double x = left + 230;
    for (const double p : {0.25, 0.5, 1.0}) {
        marks += arrow_mark(x, y + 30, {0, 1, p}, 56, svg::ink);
        marks += svg::text(x + 26, y + 34.5, svg::number(p), "");
        x += 86;
    }
    return svg::open(right + 24, y + 56, policy.title) + marks + "</svg>\n";
}

// One colour for each of ten paths: Okabe and Ito's but black, three of Tol's that stand apart from them, grey.
inline constexpr const char* path_colours[] = {"#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00",
                                               "#56B4E9", "#332288", "#882255", "#999933", "#777777"};

// A map of cells as a picture.
struct MazeFrame {
    int rows = 0, columns = 0;
    std::vector<Cell> walls;
    double size = 0, left = 48, top = 76;  // size: the side of a cell

    explicit MazeFrame(const std::string& map) {
        for (int column = 0; const char c : map) {
            if (c == '1') walls.push_back({rows, column});
            columns = std::max(columns, column + (c == '/' ? 0 : 1));
            column = c == '/' ? 0 : column + 1;
            rows += c == '/' ? 1 : 0;
        }
        size = std::min(600.0 / std::max(columns, 1), 480.0 / std::max(rows, 1));
    }
    // What lies outside is drawn on the edge.
    double x(Place p) const { return left + size * (std::clamp(p.column, -0.5, columns - 0.5) + 0.5); }
    double y(Place p) const { return top + size * (std::clamp(p.row, -0.5, rows - 0.5) + 0.5); }
    double right() const { return left + size * columns; }
    double bottom() const { return top + size * rows; }
};

inline bool drawable(Place p) { return svg::drawable(p.row) && svg::drawable(p.column); }

inline double squared_distance(Place a, Place b) {
    return (a.row - b.row) * (a.row - b.row) + (a.column - b.column) * (a.column - b.column);
}

// One line from place to place. Steps shorter than 0.02 cells are drawn together; the last place always counts.
inline std::string maze_line(const MazeFrame& frame, const std::vector<Place>& places, const char* colour) {
    std::string data;
    const Place* before = nullptr;  // the latest place drawn; null: the line begins anew
    for (size_t i = 0; i < places.size(); ++i) {
        const Place& p = places[i];
        const bool last = i + 1 == places.size() || !drawable(places[i + 1]);
        if (!drawable(p)) {
            before = nullptr;
        } else if (!before || last || squared_distance(p, *before) >= 0.02 * 0.02) {
            data += (before ? "" : "M ") + svg::number(frame.x(p)) + " " + svg::number(frame.y(p)) + " ";
            before = &p;
        }
    }
    if (data.empty()) return "";
    return "<path d=\"" + data + "\" " + svg::stroke(colour, 2) +
           " stroke-opacity=\"0.7\" stroke-linejoin=\"round\"/>\n";
}

inline std::string circle_mark(double x, double y, double radius, const std::string& style) {
    return "<circle" + svg::attributes({{"cx", x}, {"cy", y}, {"r", radius}}) + " " + style + "/>\n";
}

inline std::string start_mark(double x, double y, const char* colour) {
    return circle_mark(x, y, 5, std::string("fill=\"") + colour + "\" stroke=\"#FFFFFF\"");
}

inline std::string end_mark(double x, double y, const char* colour) {
    std::string out;
    for (const auto& [stroke, thickness] : {std::pair("#FFFFFF", 5.5), std::pair(colour, 3.0)})
        for (const double slope : {1, -1})
            out += svg::line(x - 5, y - 5 * slope, x + 5, y + 5 * slope, svg::stroke(stroke, thickness));
    return out;
}

inline std::string maze_map(const MazeFrame& frame) {
    std::string marks;
    for (int row = 0; row <= frame.rows; ++row) {
        const double y = frame.top + frame.size * row;
        marks += svg::line(frame.left, y, frame.right(), y, svg::stroke(svg::grid, 1));
    }
    for (int column = 0; column <= frame.columns; ++column) {
        const double x = frame.left + frame.size * column;
        marks += svg::line(x, frame.top, x, frame.bottom(), svg::stroke(svg::grid, 1));
    }
    for (const Cell& wall : frame.walls)
        marks += svg::rectangle(frame.left + frame.size * wall.column, frame.top + frame.size * wall.row, frame.size,
                                frame.size, "fill=\"#C8C8C8\" stroke=\"#B0B0B0\"");
    return marks + cell_numbers(frame.left, frame.top, frame.size, frame.rows, frame.columns);
}

// Starts and ends lie on top of all lines, lines on top of the goals. A goal that all paths share is drawn once;
// otherwise each has its path's colour.
inline std::string maze_paths(const MazePaths& maze) {
    const MazeFrame frame(maze.map);
    std::string goals, lines, ends;
    const bool shared = std::all_of(maze.paths.begin(), maze.paths.end(), [&](const MazePath& path) {
        return path.goal.row == maze.paths[0].goal.row && path.goal.column == maze.paths[0].goal.column;
    });
    const std::string shared_goal = "fill=\"#FFF1B8\" stroke=\"#222222\" stroke-width=\"1.5\"";
    for (size_t i = 0; i < maze.paths.size(); ++i) {
        const MazePath& path = maze.paths[i];
        const char* colour = path_colours[i % std::size(path_colours)];
        if (drawable(path.goal) && svg::drawable(maze.goal_radius) && (!shared || i == 0))
            goals += circle_mark(frame.x(path.goal), frame.y(path.goal), frame.size * maze.goal_radius,
                                 shared ? shared_goal : svg::stroke(colour, 1.5));
        lines += maze_line(frame, path.places, colour);
        if (path.places.empty()) continue;
        const Place &first = path.places.front(), &last = path.places.back();
        if (drawable(first)) ends += start_mark(frame.x(first), frame.y(first), colour);
        if (drawable(last)) ends += end_mark(frame.x(last), frame.y(last), colour);
    }

    const double y = frame.bottom() + 28;
    double x = frame.left + 8;
    const auto key = [&](const std::string& mark, const std::string& label) {
        ends += mark + svg::text(x + 15, y + 4.5, label, "");
        x += 15 + svg::text_width(label, 13) + 30;
    };
    key(start_mark(x, y, svg::faint_ink), "start");
    key(end_mark(x, y, svg::faint_ink), "end");
    key(circle_mark(x, y, 8, shared ? shared_goal : svg::stroke(svg::faint_ink, 1.5)), maze.goal_label);
    return svg::open(frame.right() + 24, y + 28, maze.title) + maze_map(frame) + goals + lines + ends + "</svg>\n";
}

// ---------------------------------------------------------------------------------------------------------------------
// Tables and the page

// Comma-separated, one header line, every line ended by a line feed, no quotes: what AppendFile logs hold.
inline Table parse_csv(std::string_view text, const std::string& path) {
    Table table;
    for (size_t line = 1; !text.empty() || line == 1; ++line) {
        const size_t length = text.find('\n');
        if (length == std::string_view::npos)
            fail("csv.unfinished", "%s: line %zu does not end; the file was cut off or is still being written",
                 path.c_str(), line);
        std::vector<std::string> fields(1);
        for (const char c : text.substr(0, length)) {
            if (c == '"' || c == '\r' || c == '\0')
                fail("csv.character", "%s: line %zu: quotes, carriage returns and zero bytes are not allowed",
                     path.c_str(), line);
            if (c == ',')
                fields.emplace_back();
            else
                fields.back() += c;
        }
        if (line == 1)
            table.header = fields;
        else if (fields.size() != table.header.size())
            fail("csv.fields", "%s: line %zu has %zu fields, the header has %zu", path.c_str(), line, fields.size(),
                 table.header.size());
        else
            table.rows.push_back(fields);
        text.remove_prefix(length + 1);
    }
    return table;
}

// The numbers of one column; an empty field (not measured) is NaN.
inline std::vector<double> numbers(const Table& table, const std::string& column, const std::string& path) {
    const auto found = std::find(table.header.begin(), table.header.end(), column);
    if (found == table.header.end())
        fail("csv.column", "%s: line 1 has no column \"%s\"", path.c_str(), column.c_str());
    const auto place = static_cast<size_t>(found - table.header.begin());
    std::vector<double> out;
    for (size_t i = 0; i < table.rows.size(); ++i) {
        const std::string& field = table.rows[i][place];
        double value = std::numeric_limits<double>::quiet_NaN();
        const auto [end, error] = std::from_chars(field.data(), field.data() + field.size(), value);
        if (!field.empty() && (error != std::errc() || end != field.data() + field.size()))
            fail("csv.number", "%s: line %zu: column \"%s\" holds \"%s\", expected a number", path.c_str(), i + 2,
                 column.c_str(), field.c_str());
        out.push_back(value);
    }
    return out;
}

inline std::string markdown_table(const Table& table) {
    const auto row = [](const std::vector<std::string>& fields) {
        std::string out = "|";
        for (const std::string& field : fields) {
            out += ' ';
            for (const char c : field) out += c == '|' ? "\\|" : std::string(1, c);
            out += " |";
        }
        return out + "\n";
    };
    std::string out = row(table.header) + row(std::vector<std::string>(table.header.size(), "---"));
    for (const auto& fields : table.rows) out += row(fields);
    return out;
}

inline std::string html_table(const Table& table) {
    const auto row = [](const std::vector<std::string>& fields, const std::string& tag) {
        std::string out = "<tr>";
        for (const std::string& field : fields) out += "<" + tag + ">" + svg::escaped(field) + "</" + tag + ">";
        return out + "</tr>\n";
    };
    std::string out = "<div class=\"wide\"><table>\n<thead>" + row(table.header, "th") + "</thead>\n<tbody>\n";
    for (const auto& fields : table.rows) out += row(fields, "td");
    return out + "</tbody></table></div>\n";
}

// One file that needs nothing else. On a narrow screen wide tables and figures scroll in their own box.
inline std::string html_page(const std::string& title, const std::vector<Section>& sections) {
    std::string out =
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\"/>\n"
        "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"/>\n<title>" +
        svg::escaped(title) +
        "</title>\n<style>\n"
        "body { margin: 2rem auto; max-width: 46rem; padding: 0 1rem; font: 16px/1.55 sans-serif;\n"
        "  color: #222; background: #fff }\n"
        "h1 { font-size: 1.7rem; line-height: 1.2 } h2 { font-size: 1.25rem; margin-top: 2.5rem }\n"
        ".wide { overflow-x: auto } figure { margin: 1.5rem 0 } figcaption { color: #555; font-size: 0.9rem }\n"
        "svg { display: block; max-width: 100%; min-width: 30rem; height: auto }\n"
        "table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: 1rem 0 }\n"
        "th, td { padding: 0.3rem 0.8rem; border-bottom: 1px solid #ddd; text-align: right; white-space: nowrap }\n"
        "th { border-bottom: 2px solid #222 } th:first-child, td:first-child { text-align: left; padding-left: 0 }\n"
        "</style>\n</head>\n<body>\n<h1>" +
        svg::escaped(title) + "</h1>\n";
    for (const Section& section : sections) {
        out += "<h2>" + svg::escaped(section.heading) + "</h2>\n";
        for (const std::string& paragraph : section.paragraphs) out += "<p>" + svg::escaped(paragraph) + "</p>\n";
        for (const Table& table : section.tables) out += html_table(table);
        for (const Figure& figure : section.figures)
            out += "<figure><div class=\"wide\">" + figure.svg + "</div><figcaption>" + svg::escaped(figure.caption) +
                   "</figcaption></figure>\n";
    }
    return out + "</body>\n</html>\n";
}
