// figures.hpp: charts and pictures as SVG text, and the tables and pages around them as HTML, Markdown or plain text.
//
//   +---------------------------------------+   A figure is 720 units wide and set in type of 13 and more, so that it
//   | title                                 |   can be read at half that width. Colours: Okabe and Ito's, distinct to
//   | y |  grid, bands, lines or bars       |   colour-blind eyes. The background is painted, so that figures read on
//   |   +---------------------------------  |   dark pages too. The legend has its own rows below the plot: it never
//   |      x ticks, x label, legend rows    |   covers data.
//   +---------------------------------------+
//
// Promises: equal data give equal text in every locale; no scripts, fonts or other files are needed; all text is
// escaped; NaN breaks a line or leaves a bar out and is never written as a coordinate.
// Leaves out: knowledge of what is drawn (labels come from the caller, in UTF-8), interaction, exact text widths.
// Order: what to draw; SVG elements; axes; the frame of a chart; line and bar charts; maps of cells; tables and pages.
#pragma once

#include <algorithm>
#include <charconv>
#include <cmath>
#include <limits>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "../nn.hpp"

// ---------------------------------------------------------------------------------------------------------------------
// What to draw

// An index into svg::colours. The caller keeps one colour for one method.
enum class Colour { blue, vermillion, green, purple, orange, sky, black };

struct Series {
    std::string label;
    Colour colour;
    std::vector<double> x, mean, deviation;  // deviation: half the height of the band, or empty
};
// A dashed horizontal line.
struct Reference {
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
    std::vector<double> values, deviation;  // one per category, not negative; deviation: half an error bar, or empty
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
    double row, column;  // in cells; whole numbers are the middles of cells
};
struct MazePath {
    Place goal;
    std::vector<Place> places;  // from the start to the end
};
struct MazePaths {
    std::string title, map;  // map: rows from the top, each ended by a slash; 1: wall, all else is free
    double goal_radius;      // in cells
    std::string goal_label;
    std::vector<MazePath> paths;
};

// ---------------------------------------------------------------------------------------------------------------------
// SVG elements. Coordinates are in user units, x to the right, y downwards.

namespace svg {

// Okabe and Ito's eight colours but yellow, which is faint on white.
inline constexpr const char* colours[] = {"#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000"};
inline constexpr const char *ink = "#222222", *faint_ink = "#555555", *grid = "#E2E2E2", *white = "#FFFFFF";
inline constexpr const char* centred = "text-anchor=\"middle\"";
inline constexpr const char* flush_right = "text-anchor=\"end\"";
inline constexpr const char* dashed = " stroke-dasharray=\"7 5\"";
inline constexpr double width = 720;

inline const char* hex(Colour colour) { return colours[static_cast<size_t>(colour)]; }

// False for NaN and for values beyond what single precision can take the logarithm of.
inline bool drawable(double value) { return std::fabs(value) < 1e30; }
inline bool drawable(Place p) { return drawable(p.row) && drawable(p.column); }

// A coordinate: at most two digits after the point, trailing zeros dropped; never "-0".
inline std::string number(double value) {
    char text[64];  // 1e30 has 31 digits
    std::string out(text, std::to_chars(text, std::end(text), value, std::chars_format::fixed, 2).ptr);
    out.erase(out.find_last_not_of('0') + 1);
    if (out.back() == '.') out.pop_back();
    return out == "-0" ? "0" : out;
}

// A pair of coordinates in the points of a polygon or a path.
inline std::string point(double x, double y) { return number(x) + " " + number(y); }

// Puts `to` in the place of each character `from`.
inline std::string replaced(std::string text, char from, const std::string& to) {
    for (size_t at = 0; (at = text.find(from, at)) != std::string::npos; at += to.size()) text.replace(at, 1, to);
    return text;
}

// Text for XML and HTML, outside of tags or in an attribute. XML 1.0 has no control characters: each becomes "?".
inline std::string escaped(std::string text) {
    for (char& c : text)
        if (c >= 0 && c < 0x20 && c != '\n' && c != '\t') c = '?';
    for (const auto& [c, name] : {std::pair('&', "&amp;"), {'<', "&lt;"}, {'>', "&gt;"}, {'"', "&quot;"}})
        text = replaced(text, c, name);
    return text;
}

// The beginning of an element, up to its style: <name x="1" y="2.5"
inline std::string element(const char* name, std::initializer_list<std::pair<const char*, double>> coordinates) {
    std::string out = std::string("<") + name;
    for (const auto& [attribute, value] : coordinates)
        out += std::string(" ") + attribute + "=\"" + number(value) + "\"";
    return out;
}

// Whole elements. `style` holds further attributes: fill(), stroke() and the constants above.
inline std::string rectangle(double x, double y, double w, double h, const std::string& style) {
    return element("rect", {{"x", x}, {"y", y}, {"width", w}, {"height", h}}) + " " + style + "/>\n";
}
inline std::string line(double x1, double y1, double x2, double y2, const std::string& style) {
    return element("line", {{"x1", x1}, {"y1", y1}, {"x2", x2}, {"y2", y2}}) + " " + style + "/>\n";
}
inline std::string circle(double x, double y, double radius, const std::string& style) {
    return element("circle", {{"cx", x}, {"cy", y}, {"r", radius}}) + " " + style + "/>\n";
}
inline std::string polygon(const std::string& points, const std::string& style) {
    return "<polygon points=\"" + points + "\" " + style + "/>";
}
inline std::string path(const std::string& points, const std::string& style) {
    return "<path d=\"" + points + "\" " + style + " stroke-linejoin=\"round\"/>\n";
}
inline std::string text(double x, double y, const std::string& content, const std::string& style = "") {
    return element("text", {{"x", x}, {"y", y}}) + " " + style + ">" + escaped(content) + "</text>\n";
}
inline std::string fill(const char* colour) { return std::string("fill=\"") + colour + "\""; }
inline std::string stroke(const char* colour, double thickness) {
    return std::string("fill=\"none\" stroke=\"") + colour + "\" stroke-width=\"" + number(thickness) + "\"";
}

// An estimate of the width of a text, on the wide side: there is no font to measure it with.
inline double text_width(std::string_view content, double size) {
    double em = 0;
    for (const char c : content)
        if ((c & 0xC0) != 0x80) em += c >= 'A' && c <= 'Z' ? 0.76 : 0.61;  // once per UTF-8 character
    return em * size;
}

// Of labels in the font size of ticks and legends.
inline double widest(const std::vector<std::string>& labels) {
    double out = 0;
    for (const std::string& label : labels) out = std::max(out, text_width(label, 13));
    return out;
}

// The whole figure: `marks` on a white ground below the title.
inline std::string picture(double w, double h, const std::string& title, const std::string& marks) {
    return element("svg xmlns=\"http://www.w3.org/2000/svg\"", {{"width", w}, {"height", h}}) + " viewBox=\"0 0 " +
           point(w, h) + "\" role=\"img\" aria-label=\"" + escaped(title) +
           "\" font-family=\"sans-serif\" font-size=\"13\" " + fill(ink) + ">\n" + rectangle(0, 0, w, h, fill(white)) +
           text(16, 30, title, "font-size=\"17\" font-weight=\"bold\"") + marks + "</svg>\n";
}

// ---------------------------------------------------------------------------------------------------------------------
// Axes

// 20000 -> "20,000"; -0.5 -> "0.5" after a true minus sign; very large and very small in scientific notation.
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

// The smallest and the largest value so far; low > high before the first.
struct Range {
    double low = std::numeric_limits<double>::infinity(), high = -low;

    void include(double value) {
        low = std::min(low, value);
        high = std::max(high, value);
    }
};

// Maps values low..high to coordinates from..to; other values are drawn at the nearer end.
struct Axis {
    double low = 0, high = 1, from = 0, to = 1;
    bool log = false;
    std::vector<double> ticks;
    double step = 0;  // between ticks; 0: they differ, as on a logarithmic axis

    // The float logarithm has the same bits on every processor, the double one has not.
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

// About `count` steps of 1, 2 or 5 times a power of ten, both ends on a tick. The axis starts at 0 if less than half of
// it is wasted. low > high: there is nothing to show, and the axis is 0..1.
inline Axis linear_axis(double low, double high, int count) {
    if (!(low <= high)) return linear_axis(0, 1, count);
    if (low > 0 && low <= 0.5 * high) low = 0;
    const double size = std::max(std::fabs(low), std::fabs(high));
    if (high - low < 1e-9 * size + 1e-30) {  // one value; also, `i` below must stay exact
        const double margin = 0.5 * decade(size > 1e-30 ? size : 1);
        low -= margin;
        high += margin;
    }
    const double rough = (high - low) / count;
    const double power = decade(rough), ratio = rough / power;
    Axis axis;
    axis.step = power * (ratio < 1.5 ? 1 : ratio < 3 ? 2 : ratio < 7 ? 5 : 10);
    const double first = std::floor(low / axis.step + 1e-9), last = std::ceil(high / axis.step - 1e-9);
    for (double i = first; i <= last; ++i) axis.ticks.push_back(i * axis.step);
    axis.low = axis.ticks.front();
    axis.high = axis.ticks.back();
    return axis;
}

// 0 < low. Ticks lie at 1, 2 and 5 times the powers of ten; beyond three decades at the powers alone; below a factor of
// five as on a linear axis.
inline Axis log_axis(double low, double high) {
    if (!(low <= high)) return log_axis(1, 10);
    Axis axis = linear_axis(low / 1.1, high * 1.1, 5);
    axis.log = true;
    axis.low = low / 1.1;
    axis.high = high * 1.1;
    if (high > 5 * low) {
        axis.ticks.clear();
        axis.step = 0;
        for (double power = decade(axis.low); power <= axis.high; power *= 10)
            for (const double factor : {1.0, 2.0, 5.0})
                if (factor == 1 || high < 1000 * low) axis.ticks.push_back(factor * power);
    }
    std::erase_if(axis.ticks, [&](double tick) { return tick < axis.low || tick > axis.high; });
    return axis;
}

// ---------------------------------------------------------------------------------------------------------------------
// The frame that line and bar charts share

inline constexpr double plot_top = 50, plot_bottom = 350, plot_right = width - 40;

// One entry of a legend.
struct Key {
    std::string label;
    Colour colour;
    enum Mark { solid, dashed, box } mark;
};

// A short line or a box left of the label.
inline std::string key_mark(const Key& key, double x, double y) {
    const char* colour = hex(key.colour);
    if (key.mark == Key::box) return rectangle(x + 6, y - 7, 14, 14, fill(colour));
    return line(x, y, x + 26, y, stroke(colour, 2.5) + (key.mark == Key::dashed ? dashed : ""));
}

// A chart in the making: the constructor draws the y axis, the caller the data, finish() the rest.
struct Chart {
    Axis y;
    double left = 0;           // x of the plot's left edge
    double end = plot_bottom;  // y below the labels of the x axis
    std::string marks;         // elements so far
    std::vector<Key> keys;     // of the legend

    // Horizontal grid lines with their labels, and the y label.
    Chart(const Axis& y_axis, const std::string& y_label) : y(y_axis) {
        std::vector<std::string> labels;
        for (const double tick : y.ticks) labels.push_back(y.label(tick));
        left = 50 + widest(labels);
        y.from = plot_bottom;
        y.to = plot_top;
        for (size_t i = 0; i < labels.size(); ++i) {
            const double at = y.at(y.ticks[i]);
            marks += line(left, at, plot_right, at, stroke(grid, 1));
            marks += text(left - 8, at + 4.5, labels[i], flush_right);
        }
        const std::string turned =
            " transform=\"translate(24 " + number((plot_top + plot_bottom) / 2) + ") rotate(-90)\"";
        marks += text(0, 0, y_label, std::string(centred) + " font-size=\"14\"" + turned);
    }

    // Legend entries from left to right, in as many rows of 22 as they need. Returns the y below the last row.
    double legend(double row) {
        const double first = 16;
        double x = first;
        for (const Key& key : keys) {
            if (key.label.empty()) continue;  // a single series explains itself
            const double w = 34 + text_width(key.label, 13);
            if (x > first && x + w > width - 10) {
                x = first;
                row += 22;
            }
            marks += key_mark(key, x, row) + text(x + 34, row + 4.5, key.label);
            x += w + 18;
        }
        return row + 22;
    }

    // The base line, the x label and the legend, which fix the height of the figure.
    std::string finish(const std::string& title, const std::string& x_label) {
        marks += line(left, plot_bottom, plot_right, plot_bottom, stroke(faint_ink, 1.2));
        marks += text((left + plot_right) / 2, end + 24, x_label, std::string(centred) + " font-size=\"14\"");
        const double height = legend(end + 50);
        return picture(width, height, title, marks);
    }
};

// Errors: figure.length if `values`, or `deviation` where there is one, has not `expected` numbers.
inline void check_lengths(const std::vector<double>& values, const std::vector<double>& deviation, size_t expected,
                          const std::string& label, const std::string& title) {
    const size_t got = values.size() != expected || deviation.empty() ? values.size() : deviation.size();
    if (got != expected)
        fail("figure.length", "figure \"%s\": \"%s\" has %zu values, expected %zu", title.c_str(), label.c_str(), got,
             expected);
}

// deviation[i], or 0 if there is none.
inline double deviation_at(const std::vector<double>& deviation, size_t i) {
    return deviation.empty() || !drawable(deviation[i]) ? 0 : deviation[i];
}

// ---------------------------------------------------------------------------------------------------------------------
// Line charts

// Missing values, and on a logarithmic axis those that are not positive, are left out.
inline bool shows(const LineChart& chart, double value) { return drawable(value) && (!chart.log_y || value > 1e-30); }
inline bool shows(const LineChart& chart, const Series& s, size_t i) {
    return drawable(s.x[i]) && shows(chart, s.mean[i]);
}

// What the axes must cover: the points with their bands, and the references.
inline std::pair<Range, Range> x_and_y_range(const LineChart& chart) {
    Range x, y;
    const auto include = [&](double value) {
        if (shows(chart, value)) y.include(value);
    };
    for (const Series& s : chart.series) {
        check_lengths(s.mean, s.deviation, s.x.size(), s.label, chart.title);
        for (size_t i = 0; i < s.x.size(); ++i) {
            if (!shows(chart, s, i)) continue;
            x.include(s.x[i]);
            for (const double side : {-1, 0, 1}) include(s.mean[i] + side * deviation_at(s.deviation, i));
        }
    }
    for (const Reference& r : chart.references) include(r.value);
    y.low = std::max(y.low, chart.y_floor);
    return {x, y};
}

// Ticks and their labels below the plot.
inline Axis draw_x_axis(Chart& plot, const Range& range, bool cut) {
    Axis x = linear_axis(range.low, range.high, 6);
    if (cut && range.low < range.high) {
        x.high = range.high;
        std::erase_if(x.ticks, [&](double tick) { return tick > range.high; });
    }
    x.from = plot.left;
    x.to = plot_right;
    plot.end = plot_bottom + 22;
    for (const double tick : x.ticks) {
        const double at = x.at(tick);
        plot.marks += line(at, plot_bottom, at, plot_bottom + 5, stroke(faint_ink, 1.2));
        plot.marks += text(at, plot.end, x.label(tick), centred);
    }
    return x;
}

// Points begin..end-1 of a series, none of them missing: appends their band and their line.
inline void draw_piece(std::string& bands, std::string& lines, const Series& s, size_t begin, size_t end, const Axis& x,
                       const Axis& y) {
    std::string middle, upper, lower;
    for (size_t i = begin; i < end; ++i) {
        const double px = x.at(s.x[i]), deviation = deviation_at(s.deviation, i);
        middle += point(px, y.at(s.mean[i])) + " ";
        upper += point(px, y.at(s.mean[i] + deviation)) + " ";
        lower = point(px, y.at(s.mean[i] - deviation)) + " " + lower;
    }
    const char* colour = hex(s.colour);
    if (!s.deviation.empty()) bands += polygon(upper + lower, fill(colour) + " fill-opacity=\"0.18\"") + "\n";
    lines += path("M " + middle, stroke(colour, 2.5));
    if (begin + 1 == end)  // a path of one point would be invisible
        lines += circle(x.at(s.x[begin]), y.at(s.mean[begin]), 3, fill(colour));
}

// Bands lie below all lines; references lie on top, since a line below shows in their gaps.
inline std::string line_chart(const LineChart& chart) {
    const auto [x_range, y_range] = x_and_y_range(chart);
    Chart plot(chart.log_y ? log_axis(y_range.low, y_range.high) : linear_axis(y_range.low, y_range.high, 5),
               chart.y_label);
    const Axis x = draw_x_axis(plot, x_range, chart.cut_x);
    std::string bands, lines;
    for (const Series& s : chart.series) {
        plot.keys.push_back({s.label, s.colour, Key::solid});
        size_t end = 0;
        for (size_t begin = 0; begin < s.x.size(); begin = end + 1) {
            end = begin;
            while (end < s.x.size() && shows(chart, s, end)) ++end;
            if (begin < end) draw_piece(bands, lines, s, begin, end, x, plot.y);
        }
    }
    for (const Reference& r : chart.references) {
        if (!shows(chart, r.value)) continue;
        plot.keys.push_back({r.label, r.colour, Key::dashed});
        const double at = plot.y.at(r.value);
        lines += line(plot.left, at, plot_right, at, stroke(hex(r.colour), 2) + dashed);
    }
    plot.marks += bands + lines;
    return plot.finish(chart.title, chart.x_label);
}

// ---------------------------------------------------------------------------------------------------------------------
// Bar charts

// Labels below categories that are `slot` wide: flat if they fit, else slanted. Sets where they end.
inline void draw_categories(Chart& plot, const std::vector<std::string>& labels, double slot) {
    const double width_of_all = widest(labels);
    const bool slanted = width_of_all + 8 > slot;
    for (size_t i = 0; i < labels.size(); ++i) {
        const double x = plot.left + slot * (static_cast<double>(i) + 0.5), y = plot_bottom + 14;
        const std::string turned = " transform=\"rotate(-45 " + point(x + 4, y) + ")\"";
        plot.marks += slanted ? text(x + 4, y, labels[i], flush_right + turned) : text(x, y + 6, labels[i], centred);
    }
    plot.end = plot_bottom + (slanted ? 14 + 0.71 * width_of_all : 22);
}

// The bars of one series: in each slot, `bar` wide and `offset` right of the slot's left edge.
inline void draw_bars(Chart& plot, const Bars& s, double slot, double offset, double bar) {
    for (size_t i = 0; i < s.values.size(); ++i) {
        if (!drawable(s.values[i])) continue;
        const double x = plot.left + slot * (static_cast<double>(i) + 0.1) + offset, top = plot.y.at(s.values[i]);
        plot.marks += rectangle(x, top, 0.92 * bar, plot.y.at(0) - top, fill(hex(s.colour)));
        const double deviation = deviation_at(s.deviation, i), middle = x + 0.46 * bar;
        if (deviation > 0)
            plot.marks += line(middle, plot.y.at(s.values[i] + deviation), middle, plot.y.at(s.values[i] - deviation),
                               stroke(ink, 1.5));
    }
}

// Groups of bars side by side, one group per category; the y axis starts at 0.
inline std::string bar_chart(const BarChart& chart) {
    double high = 0;
    for (const Bars& s : chart.series) {
        check_lengths(s.values, s.deviation, chart.categories.size(), s.label, chart.title);
        for (size_t i = 0; i < s.values.size(); ++i)
            if (drawable(s.values[i])) high = std::max(high, s.values[i] + deviation_at(s.deviation, i));
    }
    Chart plot(linear_axis(0, high > 0 ? high : 1, 5), chart.y_label);
    const double slot = (plot_right - plot.left) / std::max(1.0, static_cast<double>(chart.categories.size()));
    const double bar = 0.8 * slot / std::max(1.0, static_cast<double>(chart.series.size()));
    for (size_t k = 0; k < chart.series.size(); ++k) {
        plot.keys.push_back({chart.series[k].label, chart.series[k].colour, Key::box});
        draw_bars(plot, chart.series[k], slot, bar * static_cast<double>(k), bar);
    }
    draw_categories(plot, chart.categories, slot);
    return plot.finish(chart.title, chart.x_label);
}

// ---------------------------------------------------------------------------------------------------------------------
// Maps of cells: a policy on the grid world, and paths through a maze

inline constexpr const char *cell_border = " stroke=\"#B0B0B0\"", *path_cell = "#B9DAEF";
inline constexpr double map_left = 48, map_top = 76;

// Square cells, `size` wide; rows are numbered from 0 at the left, columns on top.
struct CellMap {
    int rows, columns;
    double size;

    double x(double column) const { return map_left + size * column; }  // of the left edge of a cell
    double y(double row) const { return map_top + size * row; }         // of its upper edge
    // The middle of a cell is a Place of whole numbers; a place outside is drawn on the edge.
    double x(Place p) const { return x(std::clamp(p.column, -0.5, columns - 0.5) + 0.5); }
    double y(Place p) const { return y(std::clamp(p.row, -0.5, rows - 0.5) + 0.5); }

    // The numbers of all rows and columns.
    std::string numbers() const {
        std::string out;
        for (int row = 0; row < rows; ++row)
            out += text(map_left - 10, y(row + 0.5) + 4.5, std::to_string(row), flush_right);
        for (int column = 0; column < columns; ++column)
            out += text(x(column + 0.5), map_top - 9, std::to_string(column), centred);
        return out;
    }
    // One cell, filled.
    std::string cell(int row, int column, const char* colour) const {
        return rectangle(x(column), y(row), size, size, fill(colour) + cell_border);
    }
    // The whole figure, with room for a legend below the map.
    std::string picture(double legend_height, const std::string& title, const std::string& marks) const {
        return svg::picture(x(columns) + 24, y(rows) + legend_height, title, marks);
    }
};

// An arrow centred at (x, y), longer and darker the more probable; `size` is the side of a cell.
inline std::string arrow_mark(double x, double y, const Arrow& arrow, double size) {
    const double norm = std::sqrt(static_cast<double>(arrow.drow * arrow.drow + arrow.dcolumn * arrow.dcolumn));
    const double p = std::clamp(arrow.probability, 0.0, 1.0);
    const double ux = arrow.dcolumn / norm, uy = arrow.drow / norm;  // unit vector along the arrow
    const double half = size * (0.14 + 0.2 * p), head = 0.13 * size;
    const double tip_x = x + ux * half, tip_y = y + uy * half;
    const double neck_x = tip_x - ux * head, neck_y = tip_y - uy * head;
    std::string points = point(tip_x, tip_y);
    for (const double side : {0.6, -0.6}) points += " " + point(neck_x - uy * head * side, neck_y + ux * head * side);
    return "<g opacity=\"" + number(0.35 + 0.65 * p) + "\">" +
           line(x - ux * half, y - uy * half, neck_x, neck_y, stroke(ink, 0.045 * size)) + polygon(points, fill(ink)) +
           "</g>\n";
}

// A letter in a coloured disc, at the upper left of a cell.
inline std::string badge(const CellMap& map, Cell cell, const char* letter, Colour colour) {
    const double x = map.x(cell.column) + 14, y = map.y(cell.row) + 14;
    return element("circle", {{"cx", x}, {"cy", y}, {"r", 11}}) + " " + fill(hex(colour)) + "/>" +
           text(x, y + 5, letter,
                std::string(centred) + " font-weight=\"bold\" font-size=\"14\" style=\"fill:#FFFFFF\"");
}

// Two rows, the first at height y: the colour of the path, and arrows of three probabilities.
inline std::string grid_legend(double y) {
    std::string out = rectangle(map_left, y - 8, 16, 16, fill(path_cell) + cell_border) +
                      text(map_left + 24, y + 4.5, "cells on the greedy path") +
                      text(map_left, y + 34.5, "most likely action, probability");
    double x = map_left + 230;
    for (const double p : {0.25, 0.5, 1.0}) {
        out += arrow_mark(x, y + 30, {0, 1, p}, 56) + text(x + 26, y + 34.5, number(p));
        x += 86;
    }
    return out;
}

// The cells of the path in blue, an arrow in each cell, S and G.
inline std::string grid_policy(const GridPolicy& policy) {
    if (policy.arrows.size() != static_cast<size_t>(policy.rows * policy.columns))
        fail("figure.length", "figure \"%s\": %zu arrows for %d rows of %d cells", policy.title.c_str(),
             policy.arrows.size(), policy.rows, policy.columns);
    const CellMap map{policy.rows, policy.columns, 480.0 / std::max({policy.rows, policy.columns, 1})};
    std::string marks;
    for (int row = 0; row < policy.rows; ++row) {
        for (int column = 0; column < policy.columns; ++column) {
            const bool on_path = std::any_of(policy.path.begin(), policy.path.end(),
                                             [&](Cell cell) { return cell.row == row && cell.column == column; });
            marks += map.cell(row, column, on_path ? path_cell : white);
            const Arrow& arrow = policy.arrows[static_cast<size_t>(row * policy.columns + column)];
            if ((arrow.drow != 0 || arrow.dcolumn != 0) && drawable(arrow.probability))
                marks += arrow_mark(map.x(column) + map.size / 2, map.y(row) + map.size / 2, arrow, map.size);
        }
    }
    marks += map.numbers() + badge(map, policy.start, "S", Colour::black) +
             badge(map, policy.goal, "G", Colour::vermillion) + grid_legend(map.y(policy.rows) + 28);
    return map.picture(84, policy.title, marks);
}

// One colour for each of ten paths: Okabe and Ito's but black, three of Tol's that stand apart from them, grey.
inline constexpr const char* path_colours[] = {"#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00",
                                               "#56B4E9", "#332288", "#882255", "#999933", "#777777"};
inline constexpr const char* shared_goal = "fill=\"#FFF1B8\" stroke=\"#222222\" stroke-width=\"1.5\"";

// Reads the size and the walls of a map (see MazePaths).
inline CellMap read_maze(const std::string& text, std::vector<Cell>& walls) {
    CellMap map{0, 0, 0};
    int column = 0;
    for (const char c : text) {
        if (c == '1') walls.push_back({map.rows, column});
        if (c == '/') ++map.rows;
        column = c == '/' ? 0 : column + 1;
        map.columns = std::max(map.columns, column);
    }
    map.size = std::min(600.0 / std::max(map.columns, 1), 480.0 / std::max(map.rows, 1));
    return map;
}

// Grid lines, walls in grey, and the numbers of rows and columns.
inline std::string maze_map(const CellMap& map, const std::vector<Cell>& walls) {
    std::string marks;
    for (int row = 0; row <= map.rows; ++row)
        marks += line(map_left, map.y(row), map.x(map.columns), map.y(row), stroke(grid, 1));
    for (int column = 0; column <= map.columns; ++column)
        marks += line(map.x(column), map_top, map.x(column), map.y(map.rows), stroke(grid, 1));
    for (const Cell& wall : walls) marks += map.cell(wall.row, wall.column, "#C8C8C8");
    return marks + map.numbers();
}

inline double squared_distance(Place a, Place b) {
    return (a.row - b.row) * (a.row - b.row) + (a.column - b.column) * (a.column - b.column);
}

// One line from place to place, broken where a place is missing. Steps shorter than 0.02 cells are drawn together; the
// last place before a gap or the end is always drawn.
inline std::string maze_line(const CellMap& map, const std::vector<Place>& places, const char* colour) {
    std::string points;
    const Place* before = nullptr;  // the latest place drawn; null: the line begins anew
    for (size_t i = 0; i < places.size(); ++i) {
        const Place& p = places[i];
        const bool last = i + 1 == places.size() || !drawable(places[i + 1]);
        if (!drawable(p)) {
            before = nullptr;
        } else if (!before || last || squared_distance(p, *before) >= 0.02 * 0.02) {
            points += (before ? "" : "M ") + point(map.x(p), map.y(p)) + " ";
            before = &p;
        }
    }
    return points.empty() ? "" : path(points, stroke(colour, 2) + " stroke-opacity=\"0.7\"");
}

// A disc with a white outline.
inline std::string start_mark(double x, double y, const char* colour) {
    return circle(x, y, 5, fill(colour) + " stroke=\"#FFFFFF\"");
}

// A cross with a white outline.
inline std::string end_mark(double x, double y, const char* colour) {
    std::string out;
    for (const auto& [ink_of_stroke, thickness] : {std::pair(white, 5.5), std::pair(colour, 3.0)})
        for (const double slope : {1, -1})
            out += line(x - 5, y - 5 * slope, x + 5, y + 5 * slope, stroke(ink_of_stroke, thickness));
    return out;
}

// One row at height y: what starts, ends and goals look like.
inline std::string maze_legend(double y, const std::string& goal_style, const std::string& goal_label) {
    std::string out;
    double x = map_left + 8;
    const auto key = [&](const std::string& mark, const std::string& label) {
        out += mark + text(x + 15, y + 4.5, label);
        x += 15 + text_width(label, 13) + 30;
    };
    key(start_mark(x, y, faint_ink), "start");
    key(end_mark(x, y, faint_ink), "end");
    key(circle(x, y, 8, goal_style), goal_label);
    return out;
}

// Starts and ends lie on top of all lines, lines on top of the goals. A goal that all paths share is drawn once;
// otherwise each has its path's colour.
inline std::string maze_paths(const MazePaths& maze) {
    std::vector<Cell> walls;
    const CellMap map = read_maze(maze.map, walls);
    const bool shared = std::all_of(maze.paths.begin(), maze.paths.end(), [&](const MazePath& path) {
        return path.goal.row == maze.paths[0].goal.row && path.goal.column == maze.paths[0].goal.column;
    });
    const auto goal_style = [&](const char* colour) { return shared ? shared_goal : stroke(colour, 1.5); };
    std::string goals, lines, ends;
    for (size_t i = 0; i < maze.paths.size(); ++i) {
        const auto& [goal, places] = maze.paths[i];
        const char* colour = path_colours[i % std::size(path_colours)];
        if (drawable(goal) && drawable(maze.goal_radius) && (!shared || i == 0))
            goals += circle(map.x(goal), map.y(goal), map.size * maze.goal_radius, goal_style(colour));
        lines += maze_line(map, places, colour);
        if (places.empty()) continue;
        const Place &first = places.front(), &last = places.back();
        if (drawable(first)) ends += start_mark(map.x(first), map.y(first), colour);
        if (drawable(last)) ends += end_mark(map.x(last), map.y(last), colour);
    }
    const std::string legend = maze_legend(map.y(map.rows) + 28, goal_style(faint_ink), maze.goal_label);
    return map.picture(56, maze.title, maze_map(map, walls) + goals + lines + ends + legend);
}

}  // namespace svg

using svg::bar_chart, svg::grid_policy, svg::line_chart, svg::maze_paths;

// ---------------------------------------------------------------------------------------------------------------------
// Tables, from CSV and to plain text

struct Table {
    std::vector<std::string> header;
    std::vector<std::vector<std::string>> rows;
};

// Comma-separated values as the logs hold them: one header line, every line ended by a line feed, no quotes.
// Errors: csv.unfinished, csv.character, csv.fields, each with `path` and the line.
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
        text.remove_prefix(length + 1);
        if (line > 1 && fields.size() != table.header.size())
            fail("csv.fields", "%s: line %zu has %zu fields, the header has %zu", path.c_str(), line, fields.size(),
                 table.header.size());
        (line == 1 ? table.header : table.rows.emplace_back()) = fields;
    }
    return table;
}

// One column from top to bottom. Errors: csv.column.
inline std::vector<std::string> texts(const Table& table, const std::string& column, const std::string& path) {
    const auto found = std::find(table.header.begin(), table.header.end(), column);
    if (found == table.header.end())
        fail("csv.column", "%s: line 1 has no column \"%s\"", path.c_str(), column.c_str());
    std::vector<std::string> out;
    for (const auto& row : table.rows) out.push_back(row[static_cast<size_t>(found - table.header.begin())]);
    return out;
}

// The numbers of one column; an empty field (not measured) is NaN. Errors: csv.column, csv.number.
inline std::vector<double> numbers(const Table& table, const std::string& column, const std::string& path) {
    std::vector<double> out;
    for (const std::string& field : texts(table, column, path)) {
        double value = std::numeric_limits<double>::quiet_NaN();
        const auto [end, error] = std::from_chars(field.data(), field.data() + field.size(), value);
        if (!field.empty() && (error != std::errc() || end != field.data() + field.size()))
            fail("csv.number", "%s: line %zu: column \"%s\" holds \"%s\", expected a number", path.c_str(),
                 out.size() + 2, column.c_str(), field.c_str());
        out.push_back(value);
    }
    return out;
}

// For a terminal: columns aligned to the right, the first to the left. Widths count characters, not bytes.
inline std::string text_table(const Table& table) {
    const auto characters = [](const std::string& text) {
        return static_cast<size_t>(std::count_if(text.begin(), text.end(), [](char c) { return (c & 0xC0) != 0x80; }));
    };
    std::vector<std::vector<std::string>> rows = table.rows;
    rows.insert(rows.begin(), table.header);
    std::vector<size_t> widths(table.header.size(), 0);
    for (const auto& row : rows)
        for (size_t i = 0; i < widths.size(); ++i) widths[i] = std::max(widths[i], characters(row[i]));
    std::string out;
    for (const auto& row : rows) {
        for (size_t i = 0; i < widths.size(); ++i) {
            const std::string space(widths[i] - characters(row[i]), ' ');
            out += i == 0 ? row[0] + space : "  " + space + row[i];
        }
        out += "\n";
    }
    return out;
}

// ---------------------------------------------------------------------------------------------------------------------
// Tables and pages in Markdown and HTML

struct Figure {
    std::string svg, caption;
    std::string file = "";  // its name, for Markdown pages
};
struct Section {
    std::string heading;
    std::vector<std::string> paragraphs;
    std::vector<Table> tables;
    std::vector<Figure> figures;
    std::string verdict = "";  // one sentence for the top of the page, or empty
};

// A vertical bar would end a field.
inline std::string markdown_row(const std::vector<std::string>& fields) {
    std::string out = "|";
    for (const std::string& field : fields) out += " " + svg::replaced(field, '|', "\\|") + " |";
    return out + "\n";
}

inline std::string markdown_table(const Table& table) {
    std::string out = markdown_row(table.header) + markdown_row(std::vector<std::string>(table.header.size(), "---"));
    for (const auto& row : table.rows) out += markdown_row(row);
    return out;
}

// Text between the tags of one HTML element.
inline std::string tagged(const std::string& tag, const std::string& text) {
    return "<" + tag + ">" + svg::escaped(text) + "</" + tag + ">";
}

inline std::string html_row(const std::vector<std::string>& fields, const char* tag) {
    std::string out = "<tr>";
    for (const std::string& field : fields) out += tagged(tag, field);
    return out + "</tr>\n";
}

inline std::string html_table(const Table& table) {
    std::string out = "<div class=\"wide\"><table>\n<thead>" + html_row(table.header, "th") + "</thead>\n<tbody>\n";
    for (const auto& row : table.rows) out += html_row(row, "td");
    return out + "</tbody></table></div>\n";
}

// The title, all verdicts, then the sections; figures are links to their files.
inline std::string markdown_page(const std::string& title, const std::vector<Section>& sections) {
    std::string out = "# " + title + "\n";
    for (const Section& section : sections)
        if (!section.verdict.empty()) out += "\n" + section.verdict + "\n";
    for (const Section& section : sections) {
        out += "\n## " + section.heading + "\n";
        for (const std::string& paragraph : section.paragraphs) out += "\n" + paragraph + "\n";
        for (const Table& table : section.tables) out += "\n" + markdown_table(table);
        for (const Figure& figure : section.figures) out += "\n![](" + figure.file + ")\n\n" + figure.caption + "\n";
    }
    return out;
}

inline constexpr const char* style_sheet =
    "body { margin: 2rem auto; max-width: 46rem; padding: 0 1rem; font: 16px/1.55 sans-serif;\n"
    "  color: #222; background: #fff }\n"
    "h1 { font-size: 1.7rem; line-height: 1.2 } h2 { font-size: 1.25rem; margin-top: 2.5rem }\n"
    ".wide { overflow-x: auto } figure { margin: 1.5rem 0 } figcaption { color: #555; font-size: 0.9rem }\n"
    "svg { display: block; max-width: 100%; min-width: 30rem; height: auto }\n"
    "table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: 1rem 0 }\n"
    "th, td { padding: 0.3rem 0.8rem; border-bottom: 1px solid #ddd; text-align: right; white-space: nowrap }\n"
    "th { border-bottom: 2px solid #222 } th:first-child, td:first-child { text-align: left; padding-left: 0 }\n";

// The same page as one file that needs nothing else. On a narrow screen wide tables and figures scroll in their own
// box.
inline std::string html_page(const std::string& title, const std::vector<Section>& sections) {
    std::string out =
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\"/>\n"
        "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"/>\n" +
        tagged("title", title) + "\n<style>\n" + style_sheet + "</style>\n</head>\n<body>\n" + tagged("h1", title) +
        "\n";
    for (const Section& section : sections)
        if (!section.verdict.empty()) out += tagged("p", section.verdict) + "\n";
    for (const Section& section : sections) {
        out += tagged("h2", section.heading) + "\n";
        for (const std::string& paragraph : section.paragraphs) out += tagged("p", paragraph) + "\n";
        for (const Table& table : section.tables) out += html_table(table);
        for (const Figure& figure : section.figures)
            out += "<figure><div class=\"wide\">" + figure.svg + "</div>" + tagged("figcaption", figure.caption) +
                   "</figure>\n";
    }
    return out + "</body>\n</html>\n";
}
