// figures.hpp: charts and maps of cells as SVG text, and pages of sentences, tables and figures as HTML and Markdown.
//
//   +---------------------------------------+   A chart is 720 units wide and set in type of 13 and more, so that it
//   | title, subtitle                       |   can be read at half that width. Colours: Okabe and Ito's, distinct to
//   | y |  grid, lines, or bars             |   colour-blind eyes. The background is painted, so that figures read on
//   |   +---------------------------------  |   dark pages too. The legend has its own rows below the plot: it never
//   |      x ticks, x label, legend rows    |   covers data.
//   +---------------------------------------+
//
// Promises: equal data give equal text in every locale; no scripts, fonts or other files are needed; all text is
// escaped; numbers that are NaN, or 1e15 and beyond, are left out; nothing is drawn beyond the values that are given.
// Leaves out: knowledge of what is drawn (labels come from the caller, in UTF-8), interaction, exact text widths.
// Order: SVG elements; the whole figure; charts; maps of cells; tables and pages.
#pragma once

#include <charconv>
#include <map>
#include <set>
#include <variant>

#include "safetensors.hpp"  // and with it nn.hpp and the other standard headers

// ---------------------------------------------------------------------------------------------------------------------
// SVG elements. Coordinates are in user units, x to the right, y downwards.

namespace svg {

inline constexpr const char *blue = "#0072B2", *vermillion = "#D55E00", *green = "#009E73", *purple = "#CC79A7",
                            *sky = "#56B4E9", *black = "#000000", *ink = "#222222", *faint_ink = "#555555",
                            *faint_line = "#E2E2E2", *white = "#FFFFFF";
inline constexpr const char* centred = "text-anchor=\"middle\"";
inline constexpr const char* flush_right = "text-anchor=\"end\"";
inline constexpr double width = 720;

inline bool drawable(double value) { return std::fabs(value) < 1e15; }

// `decimals` digits after the point, at most 12; |value| < 1e20.
inline std::string fixed(double value, int decimals) {
    char text[64];
    return {text, std::to_chars(text, std::end(text), value, std::chars_format::fixed, decimals).ptr};
}

// A coordinate: at most two digits after the point, trailing zeros dropped; never "-0".
inline std::string number(double value) {
    std::string out = fixed(value, 2);
    out.erase(out.find_last_not_of('0') + 1);
    if (out.back() == '.') out.pop_back();
    return out == "-0" ? "0" : out;
}

// A pair of coordinates in a path.
inline std::string point(double x, double y) { return number(x) + " " + number(y) + " "; }

// A number for readers: 20000 -> "20,000"; -0.5 -> "0.5" after a true minus sign; "-" for NaN.
inline std::string grouped(double value, int decimals) {
    if (std::isnan(value)) return "-";
    std::string out = fixed(std::fabs(value), decimals);
    const bool negative = value < 0 && out.find_first_not_of("0.") != std::string::npos;
    for (size_t i = std::min(out.find('.'), out.size()); i > 3; i -= 3) out.insert(i - 3, ",");
    return negative ? "\u2212" + out : out;
}

// Puts `to` in the place of each character `from`.
inline std::string replaced(std::string text, char from, const std::string& to) {
    for (size_t at = 0; (at = text.find(from, at)) != std::string::npos; at += to.size()) text.replace(at, 1, to);
    return text;
}

// Text for pages, in UTF-8 and on one line: a control character, or each byte beyond ASCII if the text is no UTF-8, is
// written as \xHH, between `before` and `after`.
inline std::string visible(const std::string& text, const char* before = "", const char* after = "") {
    const bool utf8 = is_utf8(text);
    std::string out;
    for (const char c : text) {
        const bool shown = !is_control(c) && (utf8 || (c & 0x80) == 0);
        out += shown ? std::string(1, c) : before + ("\\x" + hex8(static_cast<uint8_t>(c)).substr(6)) + after;
    }
    return out;
}

// Text for XML and HTML, outside of tags or in an attribute.
inline std::string escaped(std::string text) {
    text = visible(text);
    for (const auto& [c, name] : {std::pair('&', "&amp;"), {'<', "&lt;"}, {'>', "&gt;"}, {'"', "&quot;"}})
        text = replaced(text, c, name);
    return text;
}

// An element; `style` holds further attributes: fill(), stroke() and the constants above.
inline std::string element(const std::string& name, std::initializer_list<std::pair<const char*, double>> coordinates,
                           const std::string& style, const std::string& content = "") {
    std::string out = "<" + name;
    for (const auto& [attribute, value] : coordinates)
        out += std::string(" ") + attribute + "=\"" + number(value) + "\"";
    return out + " " + style + (content.empty() ? "/>\n" : ">" + content + "</" + name + ">\n");
}
inline std::string rectangle(double x, double y, double w, double h, const std::string& style) {
    return element("rect", {{"x", x}, {"y", y}, {"width", w}, {"height", h}}, style);
}
inline std::string line(double x1, double y1, double x2, double y2, const std::string& style) {
    return element("line", {{"x1", x1}, {"y1", y1}, {"x2", x2}, {"y2", y2}}, style);
}
inline std::string circle(double x, double y, double radius, const std::string& style) {
    return element("circle", {{"cx", x}, {"cy", y}, {"r", radius}}, style);
}
// `points`: pairs of coordinates, then "Z" for a closed outline.
inline std::string path(const std::string& points, const std::string& style) {
    return "<path d=\"M " + points + "\" " + style + " stroke-linejoin=\"round\"/>\n";
}
inline std::string text(double x, double y, const std::string& content, const std::string& style = "") {
    return element("text", {{"x", x}, {"y", y}}, style, escaped(content));
}
inline std::string fill(const char* colour) { return std::string("fill=\"") + colour + "\""; }
inline std::string stroke(const char* colour, double thickness) {
    return std::string("fill=\"none\" stroke=\"") + colour + "\" stroke-width=\"" + number(thickness) + "\"";
}

// ---------------------------------------------------------------------------------------------------------------------
// The whole figure

// The number of UTF-8 characters.
inline size_t characters(const std::string& text) {
    return static_cast<size_t>(std::count_if(text.begin(), text.end(), [](char c) { return (c & 0xC0) != 0x80; }));
}

// An estimate of the width of a text in type of 13, on the wide side: there is no font to measure it with.
inline double text_width(const std::string& content) {
    const auto capitals = std::count_if(content.begin(), content.end(), [](char c) { return c >= 'A' && c <= 'Z'; });
    return 13 * (0.61 * static_cast<double>(characters(content)) + 0.15 * static_cast<double>(capitals));
}

// One entry of a legend: what is drawn, from x = 0 to 26 and around y = 0, and what it means.
struct Key {
    std::string mark, label;
};

// The title with a smaller line below it, the marks, and the legend in as many rows as it needs, the first at height
// `y`, on a white ground. Titles that are too long for `w` are set in smaller type, and below 8 widen the ground.
inline std::string picture(double w, double y, const std::string& title, const std::string& subtitle, std::string marks,
                           const std::vector<Key>& keys) {
    const auto type_of = [room = 13 * (w - 32)](const std::string& line, double most) {
        return std::clamp(room / text_width(line), 8.0, most);
    };
    const double title_type = type_of(title, 17), subtitle_type = type_of(subtitle, 12);
    w = std::max({w, 32 + text_width(title) * title_type / 13, 32 + text_width(subtitle) * subtitle_type / 13});
    double x = 16;
    for (const Key& key : keys) {
        const double needed = 34 + text_width(key.label);
        if (x > 16 && x + needed > w - 10) {
            x = 16;
            y += 24;
        }
        marks += "<g transform=\"translate(" + point(x, y) + ")\">" + key.mark + text(34, 4.5, key.label) + "</g>\n";
        x += needed + 18;
    }
    const double h = y + 22;
    return element("svg", {{"width", w}, {"height", h}},
                   "xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 " + point(w, h) +
                       "\" role=\"img\" aria-label=\"" + escaped(title + (subtitle.empty() ? "" : "; " + subtitle)) +
                       "\" font-family=\"sans-serif\" font-size=\"13\" " + fill(ink),
                   "\n" + rectangle(0, 0, w, h, fill(white)) +
                       text(16, 22, title, "font-size=\"" + number(title_type) + "\" font-weight=\"bold\"") +
                       (subtitle.empty() ? "" : text(16, 39, subtitle, "font-size=\"" + number(subtitle_type) + "\"")) +
                       marks);
}

// ---------------------------------------------------------------------------------------------------------------------
// Charts: axes, then what lies on them

struct Tick {
    double value;
    std::string label;
};

// Maps values low..high to coordinates from..to; other values are drawn at the nearer end.
struct Axis {
    double low, high, from, to;
    std::vector<Tick> ticks;

    double at(double value) const { return from + (to - from) * (std::clamp(value, low, high) - low) / (high - low); }
};

// About `count` steps of 1, 2 or 5 times a power of ten, both ends on a tick. The axis starts at 0 if less than half of
// it is wasted. low > high: there is nothing to show, and the axis is 0..1.
inline Axis linear_axis(double low, double high, int count, double from, double to) {
    if (!(low <= high)) return linear_axis(0, 1, count, from, to);
    if (low > 0 && low <= 0.5 * high) low = 0;
    const double size = std::max(std::fabs(low), std::fabs(high));
    if (high - low < 1e-9 * size + 1e-30) {  // one value; also, `i` below must stay exact
        low -= 0.5 * std::max(size, 1.0);
        high += 0.5 * std::max(size, 1.0);
    }
    const double rough = (high - low) / count, power = std::pow(10.0, std::floor(std::log10(rough)));
    const double ratio = rough / power, step = power * (ratio < 1.5 ? 1 : ratio < 3 ? 2 : ratio < 7 ? 5 : 10);
    const int decimals = std::clamp(-static_cast<int>(std::floor(std::log10(step) + 1e-9)), 0, 12);
    std::vector<Tick> ticks;
    for (double i = std::floor(low / step + 1e-9); i <= std::ceil(high / step - 1e-9); ++i)
        ticks.push_back({i * step, grouped(i * step, decimals)});
    return {ticks.front().value, ticks.back().value, from, to, ticks};
}

inline constexpr double plot_top = 50, plot_bottom = 350, plot_right = width - 40;

struct Point {
    double x, y;
};
using Line = std::vector<Point>;  // straight between its points; x never falls

// The lines of some runs, one each. Of bars x is the category's index.
struct Series {
    std::string label;
    const char* colour;
    std::vector<Line> lines;
    bool level = false;  // has no x: each line is its last point's y, dashed from side to side above the others
};
// A diamond right of the plot; each mark has a column of its own, so that they never cover each other.
struct Mark {
    std::string label;
    const char* colour;
    double value;
};
struct Chart {
    std::string title, subtitle, x_label, y_label;  // labels with units
    std::vector<std::string> categories = {};       // of the bars; empty: a chart of lines
    std::vector<Series> series = {};
    std::vector<Mark> marks = {};
    std::vector<double> covers = {};  // what the y axis covers beside the points, so that charts can be compared
    bool cuts_outliers = false;       // the y axis leaves out outliers, which are drawn at its end

    bool bars() const { return !categories.empty(); }
};

// The line's height at x; NaN before its first point and after its last.
inline double height_at(const Line& line, double x) {
    const auto right = std::ranges::upper_bound(line, x, {}, &Point::x);
    if (right == line.begin()) return NAN;
    const Point left = right[-1];
    if (left.x == x) return left.y;
    return right == line.end() ? NAN : left.y + (right->y - left.y) * (x - left.x) / (right->x - left.x);
}

// The mean of lines, as far as all of them go: straight between the points of any of them.
inline Line mean_of(const std::vector<Line>& lines) {
    std::set<double> places;
    for (const Line& line : lines)
        for (const Point& point : line) places.insert(point.x);
    Line mean;
    for (const double x : places) {
        double sum = 0;
        for (const Line& line : lines) sum += height_at(line, x);
        if (drawable(sum)) mean.push_back({x, sum / static_cast<double>(lines.size())});
    }
    return mean;
}

// What can be drawn of a chart: points that are numbers, lines with points, series with lines. A level series has, in
// the place of each line, one from side to side.
inline std::vector<Series> drawn_series(const Chart& chart) {
    std::vector<Series> all = chart.series;
    for (Series& s : all) {
        for (Line& line : s.lines) std::erase_if(line, [](const Point& p) { return !drawable(p.x) || !drawable(p.y); });
        std::erase_if(s.lines, [](const Line& line) { return line.empty(); });
        for (Line& line : s.lines)
            if (s.level) line = {{0, line.back().y}, {INFINITY, line.back().y}};
    }
    std::erase_if(all, [](const Series& s) { return s.lines.empty(); });
    return all;
}

// Values without those more than three times the distance of the quartiles beyond them (Tukey's outer fences).
inline std::vector<double> without_outliers(std::vector<double> values) {
    std::ranges::sort(values);
    const double q1 = values[values.size() / 4], q3 = values[values.size() * 3 / 4], reach = 3 * (q3 - q1);
    std::erase_if(values, [&](double value) { return reach > 0 && (value < q1 - reach || value > q3 + reach); });
    return values;
}

// The axis covers the points, the marks and what else the chart asks for; of bars the zero too. Outliers are told for
// each series by itself, so that none is left out as a whole.
inline Axis y_axis(const Chart& chart, const std::vector<Series>& series) {
    std::vector<double> values = chart.covers;
    if (chart.bars()) values.push_back(0);
    for (const Series& s : series) {
        std::vector<double> heights;
        for (const Line& line : s.lines)
            for (const Point& point : line) heights.push_back(point.y);
        if (chart.cuts_outliers) heights = without_outliers(heights);
        values.insert(values.end(), heights.begin(), heights.end());
    }
    for (const Mark& mark : chart.marks) values.push_back(mark.value);
    std::erase_if(values, [](double value) { return !drawable(value); });
    if (values.empty()) return linear_axis(0, 1, 5, plot_bottom, plot_top);
    const auto [low, high] = std::ranges::minmax(values);
    return linear_axis(low, high, 5, plot_bottom, plot_top);
}

// Lines begin at 0 and end with the last point, between ticks or not; each bar's category has a slot of width 1 around
// its index.
inline Axis x_axis(const Chart& chart, const std::vector<Series>& series, double left) {
    double last = 0;
    for (const Series& s : series)
        for (const Line& line : s.lines)
            if (!s.level) last = std::max(last, line.back().x);
    Axis axis = linear_axis(0, last > 0 ? last : 1, 6, left, plot_right);
    if (last > 0) axis.high = last;
    std::erase_if(axis.ticks, [&](const Tick& tick) { return tick.value > axis.high; });
    if (chart.bars()) axis = {-0.5, static_cast<double>(chart.categories.size()) - 0.5, left, plot_right, {}};
    for (const std::string& category : chart.categories)
        axis.ticks.push_back({static_cast<double>(axis.ticks.size()), category});
    return axis;
}

// Grid lines, ticks and labels.
inline std::string draw_axes(const Chart& chart, const Axis& x, const Axis& y) {
    std::string out;
    for (const Tick& tick : y.ticks) {
        const double at = y.at(tick.value);
        out += line(x.from, at, x.to, at, stroke(faint_line, 1)) + text(x.from - 8, at + 4.5, tick.label, flush_right);
    }
    for (const Tick& tick : x.ticks) {
        const double at = x.at(tick.value);
        out += line(at, y.from, at, y.from + 5, stroke(faint_ink, 1.2)) + text(at, y.from + 22, tick.label, centred);
    }
    const std::string larger = std::string(centred) + " font-size=\"14\"";
    const std::string upwards = " transform=\"translate(24 " + number((y.from + y.to) / 2) + ") rotate(-90)\"";
    return out + line(x.from, y.from, x.to, y.from, stroke(faint_ink, 1.2)) +
           text((x.from + x.to) / 2, y.from + 46, chart.x_label, larger) + text(0, 0, chart.y_label, larger + upwards);
}

inline std::string line_style(const Series& s, double thickness) {
    return stroke(s.colour, thickness) + (s.level ? " stroke-dasharray=\"7 5\"" : "");
}

// One series: each line thin, with a dot at every point if they lie apart on average, and their mean thick above them.
inline void draw_lines(const Series& s, const Axis& x, const Axis& y, std::string& thin, std::string& thick) {
    constexpr double apart = 12;
    const auto place = [&](const Point& p) { return point(x.at(p.x), y.at(p.y)); };
    for (const Line& line : s.lines) {
        std::string points, dots;  // a dot is a stroke of no length with round ends
        for (const Point& p : line) {
            points += place(p);
            dots += (dots.empty() ? "" : "M ") + place(p) + "h 0 ";
        }
        const double extent = x.at(line.back().x) - x.at(line.front().x);
        const bool has_dots = !s.level && extent >= apart * static_cast<double>(line.size() - 1);
        if (s.lines.size() > 1) thin += path(points, line_style(s, 1) + " stroke-opacity=\"0.5\"");
        if (has_dots) thin += path(dots, stroke(s.colour, 5) + " stroke-linecap=\"round\"");
    }
    std::string points;
    for (const Point& p : mean_of(s.lines)) points += place(p);
    if (!points.empty()) thick += path(points, line_style(s, 2.5));
}

// The bars of series k of `count`: means, each with a stroke from the lowest to the highest of its values. Bars of one
// category share 0.8 of its slot.
inline std::string draw_bars(const Series& s, size_t k, size_t count, const Axis& x, const Axis& y) {
    std::map<double, std::vector<double>> values;  // of each category
    for (const Line& line : s.lines)
        for (const Point& p : line) values[p.x].push_back(p.y);
    const double share = 0.8 / static_cast<double>(count);
    std::string out;
    for (const auto& [category, heights] : values) {
        const double mean = std::accumulate(heights.begin(), heights.end(), 0.0) / static_cast<double>(heights.size());
        const double start = category - 0.4 + share * static_cast<double>(k);
        const double left = x.at(start), w = x.at(start + 0.92 * share) - left, top = y.at(mean);
        out += rectangle(left, top, w, y.at(0) - top, fill(s.colour));
        const auto [low, high] = std::ranges::minmax(heights);
        const double middle = left + w / 2;
        if (high > low) out += line(middle, y.at(high), middle, y.at(low), stroke(ink, 1.5));
    }
    return out;
}

inline std::string diamond(double x, double y, const char* colour) {
    return path(point(x - 5, y) + point(x, y - 7) + point(x + 5, y) + point(x, y + 7) + "Z", fill(colour));
}

// Lines with their means, or bars in groups; marks beside them; the legend below. A series without points has no entry.
inline std::string draw_chart(const Chart& chart) {
    const std::vector<Series> series = drawn_series(chart);
    const Axis y = y_axis(chart, series);
    double widest = 0;
    for (const Tick& tick : y.ticks) widest = std::max(widest, text_width(tick.label));
    const Axis x = x_axis(chart, series, 50 + widest);
    std::string thin, thick, levels;
    std::vector<Key> keys;
    for (size_t k = 0; k < series.size(); ++k) {
        const Series& s = series[k];
        if (chart.bars())
            thick += draw_bars(s, k, series.size(), x, y);
        else
            draw_lines(s, x, y, thin, s.level ? levels : thick);
        const std::string key =
            chart.bars() ? rectangle(6, -7, 14, 14, fill(s.colour)) : line(0, 0, 26, 0, line_style(s, 2.5));
        keys.push_back({key, s.label});
    }
    double column = x.to + 8;
    for (const Mark& mark : chart.marks) {
        if (!drawable(mark.value)) continue;
        thick += diamond(column, y.at(mark.value), mark.colour);
        column += 11;
        keys.push_back({diamond(13, 0, mark.colour), mark.label});
    }
    double low = y.low, high = y.high;
    for (const Series& s : series)
        for (const Line& line : s.lines)
            for (const Point& p : line) low = std::min(low, p.y), high = std::max(high, p.y);
    std::string subtitle = chart.subtitle;
    for (const auto& [end, frame, word] : {std::tuple(low, y.low, "from "), {high, y.high, "up to "}})
        if (std::fabs(end - frame) > 1e-6 * (y.high - y.low))
            subtitle += "; beyond the frame: " + (word + grouped(end, std::fabs(end) < 10 ? 2 : 0));
    return picture(width, plot_bottom + 72, chart.title, subtitle, draw_axes(chart, x, y) + thin + thick + levels,
                   keys);
}

// ---------------------------------------------------------------------------------------------------------------------
// Maps of square cells: a policy on the grid world, and paths through a maze

// In cells; whole numbers are the middles of cells.
struct Place {
    double row, column;
};

// An arrow in a cell of this size, centred at (x, y), towards a neighbour: drow and dcolumn are -1, 0 or 1, not both 0.
// It is longer and darker the larger the probability p.
inline std::string arrow_mark(double x, double y, int drow, int dcolumn, double p, double size) {
    const double norm = std::hypot(drow, dcolumn), ux = dcolumn / norm, uy = drow / norm;  // unit vector along it
    const double half = size * (0.14 + 0.2 * p), head = 0.13 * size, side = 0.6 * head;
    const double tip_x = x + ux * half, tip_y = y + uy * half;
    const double neck_x = tip_x - ux * head, neck_y = tip_y - uy * head;
    return "<g opacity=\"" + number(0.35 + 0.65 * p) + "\">" +
           line(x - ux * half, y - uy * half, neck_x, neck_y, stroke(ink, 0.045 * size)) +
           path(point(tip_x, tip_y) + point(neck_x - uy * side, neck_y + ux * side) +
                    point(neck_x + uy * side, neck_y - ux * side) + "Z",
                fill(ink)) +
           "</g>\n";
}

// A disc with a white outline.
inline std::string start_mark(double x, double y, const char* colour) {
    return circle(x, y, 5, fill(colour) + " stroke=\"#FFFFFF\"");
}

// A cross with a white outline.
inline std::string end_mark(double x, double y, const char* colour) {
    std::string out;
    for (const auto& [stroke_colour, thickness] : {std::pair(white, 5.5), std::pair(colour, 3.0)})
        for (const double slope : {1, -1})
            out += line(x - 5, y - 5 * slope, x + 5, y + 5 * slope, stroke(stroke_colour, thickness));
    return out;
}

// A map of square cells. What is added lies in layers, which are named here from below to above: filled cells, below
// the lines between cells; arrows and circles; paths; their starts and ends, and letters.
struct CellMap {
    std::string title;
    int rows, columns;
    std::string filled = {}, marks = {}, paths = {}, ends = {};
    std::vector<Key> keys = {};  // of the legend
    std::string subtitle = {};

    static constexpr double left = 48, top = 76;
    double size() const { return std::min(600.0 / columns, 480.0 / rows); }  // of a cell
    // A place outside of the map is drawn on its edge.
    double x(double column) const { return left + size() * (std::clamp(column, -0.5, columns - 0.5) + 0.5); }
    double y(double row) const { return top + size() * (std::clamp(row, -0.5, rows - 0.5) + 0.5); }

    void fill_cell(Place cell, const char* colour) {
        filled += rectangle(x(cell.column - 0.5), y(cell.row - 0.5), size(), size(), fill(colour));
    }
    void add_arrow(Place cell, int drow, int dcolumn, double p) {
        marks += arrow_mark(x(cell.column), y(cell.row), drow, dcolumn, p, size());
    }
    void add_circle(Place middle, double radius, const char* colour) {  // radius: in cells
        marks += circle(x(middle.column), y(middle.row), size() * radius, stroke(colour, 1.5));
    }
    void add_path(const std::vector<Place>& places, const char* colour) {  // from the start to the end; all are numbers
        std::string points;
        for (const Place& place : places) points += point(x(place.column), y(place.row));
        paths += path(points, stroke(colour, 2) + " stroke-opacity=\"0.7\"");
        ends += start_mark(x(places.front().column), y(places.front().row), colour) +
                end_mark(x(places.back().column), y(places.back().row), colour);
    }
    void add_letter(Place cell, const char* letter, const char* colour) {  // in a disc at the upper left of the cell
        const double middle = x(cell.column - 0.5) + 14, height = y(cell.row - 0.5) + 14;
        ends += circle(middle, height, 11, fill(colour)) +
                text(middle, height + 5, letter, std::string(centred) + " " + fill(white));
    }
};

// The layers, the lines between cells, and the numbers of rows and columns from 0.
inline std::string draw_map(const CellMap& map) {
    const double right = map.x(map.columns), bottom = map.y(map.rows);
    std::string cells = map.filled;
    for (int row = 0; row <= map.rows; ++row) {
        const double edge = map.y(row - 0.5);
        cells += line(map.left, edge, right, edge, stroke("#B0B0B0", 1));
        if (row < map.rows) cells += text(map.left - 10, map.y(row) + 4.5, std::to_string(row), flush_right);
    }
    for (int column = 0; column <= map.columns; ++column) {
        const double edge = map.x(column - 0.5);
        cells += line(edge, map.top, edge, bottom, stroke("#B0B0B0", 1));
        if (column < map.columns) cells += text(map.x(column), map.top - 9, std::to_string(column), centred);
    }
    return picture(right + 24, bottom + 28, map.title, map.subtitle, cells + map.marks + map.paths + map.ends,
                   map.keys);
}

}  // namespace svg

// ---------------------------------------------------------------------------------------------------------------------
// Pages: sections of parts

// Cells of text; each row has as many as the header.
struct Table {
    std::vector<std::string> header;
    std::vector<std::vector<std::string>> rows;
    bool pages_only = false;  // not for the terminal
};
// Links to files of a folder, whose path counts from the folder of the pages.
struct Files {
    std::string label, folder;
    std::vector<std::string> names;
};
struct Figure {
    std::string svg, caption, file;  // file: its name, for Markdown pages
};
using Part = std::variant<std::string, Table, Figure, Files>;  // text: a paragraph
struct Section {
    std::string heading;
    std::vector<Part> parts;
    std::string verdict = "";  // one sentence for the top of the page, or empty
};

// A path in a link: what has a meaning of its own there, or is not ASCII, is written as a percent sign and its code.
inline std::string url_of(const std::string& path) {
    std::string url;
    for (const char c : path) {
        char code[4];
        std::snprintf(code, sizeof code, "%%%02X", static_cast<unsigned>(static_cast<uint8_t>(c)));
        url += c <= ' ' || c > '~' || std::strchr("%#?&<>()\"\\", c) ? code : std::string(1, c);
    }
    return url;
}

// One line of fields, filled up with spaces to the widths of their columns; the first is flush left.
inline std::string markdown_row(const std::vector<std::string>& fields, const std::vector<size_t>& widths) {
    std::string out = "|";
    for (size_t i = 0; i < fields.size(); ++i) {
        const std::string field = svg::replaced(svg::visible(fields[i]), '|', "\\|");  // a bar would end the field
        const std::string space(widths[i] - std::min(widths[i], svg::characters(field)), ' ');
        out += i == 0 ? " " + field + space + " |" : " " + space + field + " |";
    }
    return out + "\n";
}

// Parts as Markdown, which a terminal shows as well: tables are aligned, figures are links to their files.
struct Markdown {
    std::string heading(int level, const std::string& text) const {
        return std::string(static_cast<size_t>(level), '#') + " " + (*this)(text);
    }
    std::string operator()(const std::string& paragraph) const { return svg::visible(paragraph) + "\n\n"; }
    std::string operator()(const Table& table) const {
        std::vector<size_t> widths(table.header.size(), 3);
        std::vector<std::string> rule;
        for (size_t i = 0; i < widths.size(); ++i) {
            widths[i] = std::max(widths[i], svg::characters(table.header[i]));
            for (const auto& row : table.rows) widths[i] = std::max(widths[i], svg::characters(row[i]));
            rule.push_back(i == 0 ? std::string(widths[i], '-') : std::string(widths[i] - 1, '-') + ":");
        }
        std::string out = markdown_row(table.header, widths) + markdown_row(rule, widths);
        for (const auto& row : table.rows) out += markdown_row(row, widths);
        return out + "\n";
    }
    std::string operator()(const Figure& figure) const {
        return "![](" + url_of(figure.file) + ")\n\n" + (*this)(figure.caption);
    }
    std::string operator()(const Files& files) const {
        std::string out = svg::visible(files.label) + ":";
        for (const std::string& name : files.names) out += " [" + name + "](" + url_of(files.folder + "/" + name) + ")";
        return out + "\n\n";
    }
};

// Text between the tags of one HTML element.
inline std::string tagged(const std::string& tag, const std::string& text) {
    return "<" + tag + ">" + svg::escaped(text) + "</" + tag + ">";
}

// Parts as HTML. On a narrow screen wide tables and figures scroll in their own box; on a wide one figures that follow
// each other stand side by side.
struct Html {
    std::string heading(int level, const std::string& text) const {
        return tagged("h" + std::to_string(level), text) + "\n";
    }
    std::string operator()(const std::string& paragraph) const { return tagged("p", paragraph) + "\n"; }
    std::string row(const std::vector<std::string>& fields, const char* tag) const {
        std::string out = "<tr>";
        for (const std::string& field : fields) out += tagged(tag, field);
        return out + "</tr>\n";
    }
    std::string operator()(const Table& table) const {
        std::string out = "<div class=\"wide\"><table>\n<thead>" + row(table.header, "th") + "</thead>\n<tbody>\n";
        for (const auto& fields : table.rows) out += row(fields, "td");
        return out + "</tbody></table></div>\n";
    }
    std::string operator()(const Figure& figure) const {
        return "<figure><div class=\"wide\">" + figure.svg + "</div>" + tagged("figcaption", figure.caption) +
               "</figure>\n";
    }
    std::string operator()(const Files& files) const {
        std::string out = "<p class=\"files\">" + svg::escaped(files.label) + ":";
        for (const std::string& name : files.names)
            out += " <a href=\"" + url_of(files.folder + "/" + name) + "\">" + svg::escaped(name) + "</a>";
        return out + "</p>\n";
    }
};

// The title, all verdicts, then the sections.
inline std::string page(const auto& writer, const std::string& title, const std::vector<Section>& sections) {
    std::string out = writer.heading(1, title);
    for (const Section& section : sections)
        if (!section.verdict.empty()) out += writer(section.verdict);
    for (const Section& section : sections) {
        out += writer.heading(2, section.heading);
        for (const Part& part : section.parts) out += std::visit(writer, part);
    }
    return out;
}

inline constexpr const char* style_sheet =
    "body { margin: 2rem auto; max-width: 80rem; padding: 0 1rem; font: 16px/1.55 sans-serif; color: #222;\n"
    "  background: #fff; display: grid; grid-template-columns: 1fr 1fr; column-gap: 2rem }\n"
    "body > * { grid-column: 1 / -1; min-width: 0 } body > figure { grid-column: auto; margin: 1rem 0 }\n"
    "h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 } h2 { font-size: 1.25rem; margin: 2rem 0 0 }\n"
    "p { max-width: 50rem; margin: 0.7rem 0 } .files { margin: 0 } .wide { overflow-x: auto }\n"
    "figcaption { color: #555; font-size: 0.9rem }\n"
    "svg { display: block; max-width: 100%; min-width: 30rem; height: auto }\n"
    "table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 0.9rem; margin: 0.7rem 0 }\n"
    "th, td { padding: 0.25rem 0.7rem; border-bottom: 1px solid #ddd; text-align: right; vertical-align: top }\n"
    "td { white-space: nowrap } td:first-child, td:last-child { white-space: normal; overflow-wrap: break-word }\n"
    "th { border-bottom: 2px solid #222 } th:first-child, td:first-child { text-align: left; padding-left: 0 }\n"
    "@media (max-width: 60rem) { body > figure { grid-column: 1 / -1 } }\n";

// The page as one file that needs nothing else.
inline std::string html_page(const std::string& title, const std::vector<Section>& sections) {
    return "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\"/>\n"
           "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"/>\n" +
           tagged("title", title) + "\n<style>\n" + style_sheet + "</style>\n</head>\n<body>\n" +
           page(Html{}, title, sections) + "</body>\n</html>\n";
}
