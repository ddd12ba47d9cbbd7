// test_mujoco.cpp: the nine MuJoCo tasks: the compiled models against tables and closed forms, motion against
// mechanics, and the rules of reward, termination and reset against their definitions.
#include "../mujoco_env.hpp"
#include "test.hpp"

#ifdef WODTEM_MUJOCO

#include <unistd.h>

#include <filesystem>
#include <future>
#include <map>
#include <numeric>
#include <set>

#include "mujoco_tables.hpp"

namespace {

using Numbers = std::vector<double>;
using Row = std::vector<std::string>;

constexpr Physics both_physics[] = {Physics::d4rl, Physics::mujoco_2_2};

MujocoEnvironment make(const char* name, Physics physics = Physics::d4rl) { return {*find_mujoco_task(name), physics}; }

Numbers zeros(int count) { return Numbers(static_cast<size_t>(count)); }
Numbers positions(const MujocoEnvironment& e) { return {e.data->qpos, e.data->qpos + e.model->nq}; }
Numbers velocities(const MujocoEnvironment& e) { return {e.data->qvel, e.data->qvel + e.model->nv}; }
Numbers initial(const MujocoEnvironment& e) { return {e.model->qpos0, e.model->qpos0 + e.model->nq}; }
Numbers still(const MujocoEnvironment& e) { return zeros(e.model->nv); }

// A reset, and whether it gave the observation in single precision.
void reset(MujocoEnvironment& environment, uint64_t episode, uint32_t seed = test_seed()) {
    std::vector<float> state(environment.observation.size());
    environment.reset(Random{seed, Stream::environment}, episode, state.data());
    CHECK(state == std::vector<float>(environment.observation.begin(), environment.observation.end()));
}

// Numbers from a seed, one after the other.
struct Dice {
    uint32_t seed = test_seed();
    uint64_t drawn = 0;
    double operator()(double low, double high) {
        return low + (high - low) * Random{seed, Stream::data_set}.uniform(drawn++, 0);
    }
    Numbers operator()(int count, double low, double high) {
        Numbers numbers;
        for (int i = 0; i < count; ++i) numbers.push_back((*this)(low, high));
        return numbers;
    }
};

double largest_difference(std::span<const double> a, std::span<const double> b) {
    double largest = a.size() == b.size() ? 0 : INFINITY;
    for (size_t i = 0; i < a.size() && i < b.size(); ++i) {
        const double difference = std::fabs(a[i] - b[i]);
        if (!(difference <= largest)) largest = std::isnan(difference) ? INFINITY : difference;
    }
    return largest;
}

// ----- tables -----

// The columns of every row.
std::vector<Row> rows(std::string_view table) {
    std::vector<Row> result;
    std::istringstream lines{std::string(table)};
    for (std::string line; std::getline(lines, line);) {
        if (line.empty()) continue;
        std::istringstream columns(line);
        for (result.emplace_back(); std::getline(columns, line, '|');) {
            const size_t first = line.find_first_not_of(' ');
            result.back().push_back(line.substr(first, line.find_last_not_of(' ') + 1 - first));
        }
    }
    return result;
}

// "0.02 1 / 0 0.8" and "1/0" are lists of numbers too; "-" is none.
Numbers numbers(std::string text) {
    std::replace(text.begin(), text.end(), '/', ' ');
    std::istringstream words(text);
    Numbers result;
    for (double x; words >> x;) result.push_back(x);
    return result;
}

template <class... Texts>
Numbers numbers_of(const Texts&... texts) {
    Numbers result;
    for (const auto& some : {numbers(texts)...}) result.insert(result.end(), some.begin(), some.end());
    return result;
}

// Entry `index` of several arrays of the model, each with its number of values per entry.
template <class T, class... More>
Numbers entries(int index, const T* array, int width, const More&... more) {
    Numbers result(array + index * width, array + (index + 1) * width);
    if constexpr (sizeof...(more) > 0)
        for (const double x : entries(index, more...)) result.push_back(x);
    return result;
}

// To 1e-12, relative above 1: the tables have all digits, and what the models say in other words (degrees, a capsule's
// end points) costs an ulp or two.
void check_numbers(const std::string& where, const Numbers& got, const Numbers& expected) {
    if (got.size() != expected.size())
        return report_failure(__FILE__, __LINE__,
                              where + ": " + shown(got.size()) + " numbers, not " + shown(expected.size()));
    for (size_t i = 0; i < got.size(); ++i)
        if (!(std::fabs(got[i] - expected[i]) <= 1e-12 * std::max(1.0, std::fabs(expected[i]))))
            report_failure(
                __FILE__, __LINE__,
                where + ", number " + shown(i) + ": got " + shown(got[i]) + ", expected " + shown(expected[i]));
}

int body_number(const ModelTable& table, const std::string& name) {
    if (name[0] == '#') return std::stoi(name.substr(1));
    for (const Row& row : rows(table.bodies))
        if (row[1] == name) return std::stoi(row[0]);
    return -1;
}

template <class Names>
int index_of(const Names& names, const std::string& name) {
    return static_cast<int>(std::find(std::begin(names), std::end(names), name) - std::begin(names));
}

constexpr const char* joint_types[] = {"free", "ball", "slide", "hinge"};  // mjtJoint
constexpr const char* geom_types[] = {"plane",     "hfield",   "sphere", "capsule",
                                      "ellipsoid", "cylinder", "box"};  // mjtGeom
constexpr const char* integrators[] = {"Euler", "RK4"};
constexpr const char* cones[] = {"pyramidal", "elliptic"};
constexpr const char* solvers[] = {"PGS", "CG", "Newton"};

void check_sizes(const ModelTable& table, const mjModel& m, bool old) {
    const Row row = rows(table.sizes).at(0);
    check_numbers("sizes", {1. * m.nq, 1. * m.nv, 1. * m.nu, 1. * m.nbody, 1. * m.njnt, 1. * m.ngeom}, numbers(row[0]));
    const Row totals = old ? rows(table.old_totals).at(0) : Row{row[1], row[2]};
    check_numbers("total mass, mean inertia", {mj_getTotalmass(&m), m.stat.meaninertia},
                  numbers_of(totals[0], totals[1]));
    check_numbers("options", {m.opt.timestep, 1. * m.opt.iterations, m.opt.tolerance, 1. * m.njmax, 1. * m.nconmax},
                  numbers_of(row[3], row[7], row[8], row[9], row[10]));
    CHECK_EQUAL(m.opt.integrator, index_of(integrators, row[4]));
    CHECK_EQUAL(m.opt.cone, index_of(cones, row[5]));
    CHECK_EQUAL(m.opt.solver, index_of(solvers, row[6]));
    check_numbers("qpos0", entries(0, m.qpos0, m.nq), numbers(table.qpos0));
}

void check_bodies(const ModelTable& table, const mjModel& m, bool old) {
    const auto bodies = rows(table.bodies);
    CHECK_EQUAL(static_cast<int>(bodies.size()), m.nbody);
    for (const Row& row : bodies) {
        const int b = std::stoi(row[0]);
        check_numbers("body " + row[0], entries(b, m.body_parentid, 1, m.body_pos, 3), numbers_of(row[2], row[3]));
        const Row inertial = old && b > 0 ? rows(table.old_bodies).at(static_cast<size_t>(b) - 1) : row;
        const size_t column = old && b > 0 ? 2 : 4;
        check_numbers("inertial of body " + row[0],
                      entries(b, m.body_mass, 1, m.body_inertia, 3, m.body_ipos, 3, m.body_iquat, 4),
                      numbers_of(inertial[column], inertial[column + 1], inertial[column + 2], inertial[column + 3]));
    }
    if (old)
        for (const Row& row : rows(table.old_bodies))
            CHECK_EQUAL(row[1], bodies.at(static_cast<size_t>(body_number(table, row[0])))[4]);
}

void check_joints(const ModelTable& table, const mjModel& m) {
    const auto joints = rows(table.joints);
    CHECK_EQUAL(static_cast<int>(joints.size()), m.njnt);
    for (const Row& row : joints) {
        const int j = std::stoi(row[0]);
        CHECK_EQUAL(m.jnt_type[j], index_of(joint_types, row[2]));
        CHECK_EQUAL(m.jnt_bodyid[j], body_number(table, row[3]));
        CHECK_EQUAL(m.jnt_limited[j] != 0, row[6] == "yes");
        check_numbers("joint " + row[0],
                      entries(j, m.jnt_pos, 3, m.jnt_axis, 3, m.jnt_range, 2, m.jnt_stiffness, 1, m.jnt_solref, 2,
                              m.jnt_solimp, 5),
                      numbers_of(row[4], row[5], row[7] == "-" ? "0 0" : row[7], row[8], row[11]));
        const int dofs = m.jnt_type[j] == mjJNT_FREE ? 6 : 1;
        for (int d = m.jnt_dofadr[j]; d < m.jnt_dofadr[j] + dofs; ++d)
            check_numbers("joint " + row[0], {m.dof_damping[d], m.dof_armature[d]}, numbers_of(row[9], row[10]));
    }
}

// Of two margins MuJoCo 2.2 takes the larger, so what stands still may have 0 where nothing that moves has less than it
// has in the original.
void check_geom(const ModelTable& table, const mjModel& m, int g, const Row& row) {
    const bool still = row[2] == "world";
    for (int other = 0; other < m.ngeom && still; ++other)
        CHECK(m.geom_bodyid[other] == 0 || m.geom_margin[other] >= std::stod(row[10]));
    CHECK_EQUAL(m.geom_bodyid[g], body_number(table, row[2]));
    CHECK_EQUAL(m.geom_type[g], index_of(geom_types, row[3]));
    check_numbers("geom " + shown(g),
                  entries(g, m.geom_size, 3, m.geom_pos, 3, m.geom_quat, 4, m.geom_contype, 1, m.geom_conaffinity, 1,
                          m.geom_condim, 1, m.geom_friction, 3, m.geom_margin, 1, m.geom_solref, 2, m.geom_solimp, 5),
                  numbers_of(row[4], row[5], row[6], row[7], row[8], row[9], still ? "0" : row[10], row[11]));
}

void check_geoms(const ModelTable& table, const mjModel& m) {
    for (const Row& row : rows(table.geoms)) check_geom(table, m, std::stoi(row[0]), row);
}

void check_actuators(const ModelTable& table, const mjModel& m) {
    const auto joints = rows(table.joints), actuators = rows(table.actuators);
    CHECK_EQUAL(static_cast<int>(actuators.size()), m.nu);
    for (const Row& row : actuators) {
        const int a = std::stoi(row[0]);
        CHECK(m.actuator_trntype[a] == mjTRN_JOINT && m.actuator_ctrllimited[a]);
        CHECK_EQUAL(joints.at(static_cast<size_t>(m.actuator_trnid[2 * a]))[1], row[1]);
        check_numbers("actuator " + row[0], entries(a, m.actuator_gear, 6, m.actuator_ctrlrange, 2),
                      numbers_of(row[2], "0 0 0 0 0", row[3]));
    }
}

// ----- mechanics -----

// Of the whole robot: centre of mass, its velocity, angular momentum about it.
struct Motion {
    Numbers centre, velocity, spin;
};
Motion motion(const MujocoEnvironment& environment) {
    const MujocoEnvironment now = environment;  // a copy, brought up to date with qpos and qvel
    mj_forward(now.model.get(), now.data.get());
    mj_subtreeVel(now.model.get(), now.data.get());
    const mjData& d = *now.data;
    return {{d.subtree_com, d.subtree_com + 3},
            {d.subtree_linvel, d.subtree_linvel + 3},
            {d.subtree_angmom, d.subtree_angmom + 3}};
}

// Mass, centre and inertia tensor about the centre, in the body's frame.
struct Inertial {
    double mass = 0;
    std::array<double, 3> centre{};
    std::array<double, 9> tensor{};
};

// R diag(principal) R^T, and m (|d|^2 1 - d d^T), the parallel axes' share.
void add_rotated(std::array<double, 9>& tensor, const mjtNum* quat, const std::array<double, 3>& principal) {
    double r[9];
    mju_quat2Mat(r, quat);
    for (size_t i = 0; i < 9; ++i)
        for (size_t k = 0; k < 3; ++k) tensor[i] += r[i / 3 * 3 + k] * principal[k] * r[i % 3 * 3 + k];
}
void add_displaced(std::array<double, 9>& tensor, double mass, const std::array<double, 3>& d) {
    const double square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
    for (size_t i = 0; i < 9; ++i) tensor[i] += mass * ((i % 4 == 0 ? square : 0) - d[i / 3] * d[i % 3]);
}

// From the shapes of a body's geoms. MuJoCo up to 2.1.0 took a capsule for a cylinder of length 2h + r.
Inertial inertial_by_hand(const mjModel& m, int body, double density, bool old) {
    Inertial whole;
    struct Part {
        int geom;
        double mass;
        std::array<double, 3> principal;
    };
    std::vector<Part> parts;
    for (int g = m.body_geomadr[body]; g < m.body_geomadr[body] + m.body_geomnum[body]; ++g) {
        const double r = m.geom_size[3 * g], h = m.geom_size[3 * g + 1], pi = std::acos(-1.0);
        const double ball = density * pi * r * r * r * 4 / 3;
        if (m.geom_type[g] == mjGEOM_SPHERE) {
            parts.push_back({g, ball, {0.4 * ball * r * r, 0.4 * ball * r * r, 0.4 * ball * r * r}});
        } else if (old) {
            const double length = 2 * h + r, mass = density * pi * r * r * length;
            const double across = mass * (3 * r * r + length * length) / 12;
            parts.push_back({g, mass, {across, across, mass * r * r / 2}});
        } else {  // a cylinder and two half balls, whose centres of mass are 3r/8 from their flat sides
            const double cylinder = density * pi * r * r * 2 * h;
            const double across = cylinder * (3 * r * r + 4 * h * h) / 12 + ball * (0.4 * r * r + h * h + 0.75 * h * r);
            parts.push_back({g, cylinder + ball, {across, across, cylinder * r * r / 2 + 0.4 * ball * r * r}});
        }
    }
    for (const Part& part : parts) whole.mass += part.mass;
    for (const Part& part : parts)
        for (size_t i = 0; i < 3; ++i)
            whole.centre[i] += part.mass / whole.mass * m.geom_pos[3 * static_cast<size_t>(part.geom) + i];
    for (const Part& part : parts) {
        std::array<double, 3> away;
        for (size_t i = 0; i < 3; ++i) away[i] = m.geom_pos[3 * static_cast<size_t>(part.geom) + i] - whole.centre[i];
        add_rotated(whole.tensor, m.geom_quat + 4 * part.geom, part.principal);
        add_displaced(whole.tensor, part.mass, away);
    }
    return whole;
}

// ----- mazes -----

struct Cell {
    int row, column;
    char mark;
};
std::vector<Cell> cells(const MazeTable& maze) {
    std::vector<Cell> result;
    const auto lines = rows(maze.map);
    for (size_t i = 0; i < lines.size(); ++i)
        for (size_t j = 0; j < lines[i][0].size(); ++j)
            result.push_back({static_cast<int>(i), static_cast<int>(j), lines[i][0][j]});
    return result;
}
char mark_at(const MazeTable& maze, int row, int column) {
    for (const Cell& cell : cells(maze))
        if (cell.row == row && cell.column == column) return cell.mark;
    return '1';
}

constexpr double ball_mass = 4.0 / 3 * 3.14159265358979323846;  // radius 0.1, density 1000

// Where a wall that takes `force` keeps the ball: the distance between their surfaces, positive as the wall acts within
// its margin of 0.002. MuJoCo's soft contact at rest: the violation r = margin - distance obeys R f = k d r with
// R = (1 - d) / d * inverse weight of ball and wall, k = 1 / (0.95 * 0.02)^2 (solref 0.02 1), and the impedance d of
// solimp 0.9 0.95 0.001 0.5 2: d = 0.9 + 0.05 y, y = 2 s^2 up to s = r / 0.001 = 0.5, 1 - 2 (1 - s)^2 up to 1.
double distance_to_pushed_wall(double force) {
    const double inverse_weight = 2 / ball_mass / 3;  // a mean over x, y and z, in the last of which nothing moves
    const double stiffness = 1 / (0.95 * 0.95 * 0.02 * 0.02);
    double violation = 0;
    for (int i = 0; i < 200; ++i) {
        const double s = std::min(violation / 0.001, 1.0);
        const double impedance = 0.9 + 0.05 * (s < 0.5 ? 2 * s * s : 1 - 2 * (1 - s) * (1 - s));
        violation = force * (1 - impedance) / impedance * inverse_weight / (stiffness * impedance);
    }
    return 0.002 - violation;
}

// ----- statistics -----

struct Sample {
    double count = 0, sum = 0, squares = 0, low = INFINITY, high = -INFINITY;
    void add(double x) {
        ++count, sum += x, squares += x * x;
        low = std::min(low, x), high = std::max(high, x);
    }
    double mean() const { return sum / count; }
    double variance() const { return (squares - sum * sum / count) / (count - 1); }
    double standard_error() const { return std::sqrt(variance() / count); }
};

// Within 5 standard errors in mean and variance. A uniform variable has kurtosis 9/5, a normal one 3.
void check_uniform(const Sample& sample, double low, double high) {
    const double variance = (high - low) * (high - low) / 12;
    CHECK(sample.low >= low && sample.high <= high);
    CHECK_CLOSE(sample.mean(), (low + high) / 2, 5 * std::sqrt(variance / sample.count));
    CHECK_CLOSE(sample.variance() / variance, 1, 5 * std::sqrt(0.8 / sample.count));
}
void check_normal(const Sample& sample, double deviation) {
    CHECK_CLOSE(sample.mean(), 0, 5 * deviation / std::sqrt(sample.count));
    CHECK_CLOSE(sample.variance() / (deviation * deviation), 1, 5 * std::sqrt(2 / sample.count));
    CHECK(sample.high > 2.5 * deviation && sample.low < -2.5 * deviation);  // a uniform one would end at 1.7
}

// ----- output -----

// Hears what is printed while it lives, and fails if anything is. MuJoCo would write its log into the working folder.
struct Listener {
    std::filesystem::path before = std::filesystem::current_path();
    char folder[32] = "/tmp/wodtem-test-XXXXXX";
    int out = dup(1), err = dup(2);
    std::FILE* heard = std::tmpfile();
    Listener() {
        std::filesystem::current_path(mkdtemp(folder));
        std::fflush(nullptr);
        dup2(fileno(heard), 1), dup2(fileno(heard), 2);
    }
    ~Listener() {
        std::fflush(nullptr);
        dup2(out, 1), dup2(err, 2);
        close(out), close(err);
        std::rewind(heard);
        bool silent = true;
        for (int c; (c = std::fgetc(heard)) != EOF; silent = false) std::putchar(c);
        std::fclose(heard);
        CHECK(silent);
        CHECK(std::filesystem::is_empty(folder));
        std::filesystem::current_path(before);
        std::filesystem::remove_all(folder);
    }
};

}  // namespace

// ---------------------------------------------------------------------------------------------------------------------
// The table of tasks.

TEST(the_table_of_tasks_agrees_with_the_models_and_the_reference_returns) {
    const struct {
        const char* name;
        int state_dim, action_dim, limit;
        double seconds, low, high;
    } expected[] = {
        {"hopper", 11, 3, 1000, 0.008, -20.272305, 3234.3},       {"walker2d", 17, 6, 1000, 0.008, 1.629008, 4592.3},
        {"halfcheetah", 17, 6, 1000, 0.05, -280.178953, 12135.0}, {"ant", 111, 8, 1000, 0.05, -325.6, 3879.7},
        {"maze2d-umaze", 4, 2, 300, 0.01, 23.85, 161.86},         {"maze2d-medium", 4, 2, 600, 0.01, 13.13, 277.39},
        {"maze2d-large", 4, 2, 800, 0.01, 6.7, 273.99},           {"antmaze-umaze", 29, 8, 700, 0.1, 0.0, 1.0},
        {"antmaze-umaze-diverse", 29, 8, 700, 0.1, 0.0, 1.0},
    };
    CHECK_EQUAL(std::size(expected), mujoco_tasks.size());
    for (size_t i = 0; i < mujoco_tasks.size(); ++i) {
        const MujocoEnvironment environment(mujoco_tasks[i], Physics::d4rl);
        const MujocoTask& task = *environment.task;
        const EnvironmentSpec spec = environment.spec();
        CHECK_EQUAL(std::string(task.name), expected[i].name);
        CHECK_EQUAL(spec.state_dim, expected[i].state_dim);
        CHECK_EQUAL(spec.action_dim, expected[i].action_dim);
        CHECK_EQUAL(spec.discrete_actions, 0);
        CHECK_EQUAL(spec.max_episode_steps, expected[i].limit);
        const int forces = task.rules == Rules::ant ? 6 * environment.model->nbody : 0;
        CHECK_EQUAL(spec.state_dim, environment.model->nq - task.first_position + environment.model->nv + forces);
        CHECK_EQUAL(spec.action_dim, environment.model->nu);
        CHECK_CLOSE(environment.step_time(), expected[i].seconds, 1e-15);
        CHECK_EQUAL(normalised_score(task, expected[i].low), 0.0);
        CHECK_CLOSE(normalised_score(task, expected[i].high), 100, 1e-12);
    }
}

TEST(every_id_of_the_paper_finds_its_task_and_no_other_id_does) {
    std::vector<std::pair<std::string, std::string>> ids{{"maze2d-umaze-v1", "maze2d-umaze"},
                                                         {"maze2d-medium-v1", "maze2d-medium"},
                                                         {"maze2d-large-v1", "maze2d-large"},
                                                         {"antmaze-umaze-v2", "antmaze-umaze"},
                                                         {"antmaze-umaze-diverse-v2", "antmaze-umaze-diverse"}};
    for (const std::string name : {"hopper", "walker2d", "halfcheetah", "ant"})
        for (const char* level : {"", "-v2", "-medium-v2", "-medium-replay-v2"}) ids.push_back({name + level, name});
    for (const auto& [id, name] : ids) {
        const MujocoTask* task = find_mujoco_task(id);
        CHECK_EQUAL(task ? task->name : "none", name);
        if (!task) continue;
        CHECK_EQUAL(std::string(task->version), name.starts_with("maze2d") ? "-v1" : "-v2");
        CHECK(find_mujoco_task(name + task->version) == task);
    }
    for (const char* id :
         {"", "hopperx", "hoppe", "Hopper-v2", "antmaze", "antmaze-medium-play-v2", "maze2d-v1", "-v2"})
        CHECK(find_mujoco_task(id) == nullptr);
}

// ---------------------------------------------------------------------------------------------------------------------
// The models.

TEST(every_number_of_the_compiled_models_is_that_of_the_tables) {
    for (const ModelTable* table : model_tables) {
        for (const Physics physics : both_physics) {
            const bool old = physics == Physics::d4rl && table->old_bodies;
            const MujocoEnvironment environment = make(table->task, physics);
            const mjModel& m = *environment.model;
            const int failures = failed_checks();
            check_sizes(*table, m, old);
            check_bodies(*table, m, old);
            check_joints(*table, m);
            check_geoms(*table, m);
            check_actuators(*table, m);
            if (!old) {
                Numbers expected;
                for (const Row& row : rows(table->body_invweight0))
                    for (const double x : numbers_of(row[1], row[2])) expected.push_back(x);
                check_numbers("body_invweight0", entries(0, m.body_invweight0, 2 * m.nbody), expected);
                check_numbers("dof_invweight0", entries(0, m.dof_invweight0, m.nv), numbers(table->dof_invweight0));
            }
            if (failed_checks() != failures)
                std::printf("  (%s, %s)\n", table->task, physics_names[physics == Physics::mujoco_2_2]);
        }
    }
}

// In antmaze the ant comes after 18 walls, with contacts of its own.
TEST(the_ant_of_the_maze_is_the_ant_but_for_its_solimp) {
    for (const Physics physics : both_physics) {
        const MujocoEnvironment environment = make("antmaze-umaze", physics);
        for (Row row : rows(ant_table.geoms)) {
            row.back() = "0.02 1 / 0.8 0.8 0.01 0.5 2";
            const int number = std::stoi(row[0]);
            check_geom(ant_table, *environment.model, number == 0 ? 0 : 18 + number, row);
        }
    }
}

TEST(every_wall_of_a_maze_stands_in_its_cell) {
    for (const MazeTable& maze : maze_tables) {
        const MujocoEnvironment environment = make(maze.task);
        const mjModel& m = *environment.model;
        const bool of_ant = environment.task->rules == Rules::antmaze;
        int geom = 1;  // after the floor; row by row
        for (const Cell& cell : cells(maze)) {
            if (cell.mark != '1') continue;
            CHECK(m.geom_type[geom] == mjGEOM_BOX && m.geom_bodyid[geom] == 0);
            const Numbers at = of_ant ? Numbers{4.0 * cell.column - 4, 4.0 * cell.row - 4, 1}
                                      : Numbers{cell.row + 1.0, cell.column + 1.0, 0};
            const Numbers half = of_ant ? Numbers{2, 2, 1} : Numbers{0.5, 0.5, 0.2};
            check_numbers("wall " + shown(geom), entries(geom, m.geom_pos, 3), at);
            check_numbers("wall " + shown(geom), entries(geom, m.geom_size, 3), half);
            check_numbers("wall " + shown(geom), entries(geom, m.geom_quat, 4), {1, 0, 0, 0});
            CHECK(m.geom_contype[geom] == (of_ant ? 1 : 2) && m.geom_conaffinity[geom] == 1);
            ++geom;
        }
        CHECK_EQUAL(geom - 1, maze.walls);
        CHECK_EQUAL(m.ngeom, maze.geoms);
        if (of_ant) continue;
        check_geom(maze2d_umaze_table, m, geom,
                   {"", "", "particle", "sphere", "0.1 0 0", "0 0 0", "1 0 0 0", "1/1", "1", "0.5 0.1 0.1", "0.002",
                    "0.02 1 / 0.9 0.95 0.001 0.5 2"});
        CHECK_CLOSE(mj_getTotalmass(&m), ball_mass, 1e-14);
    }
}

TEST(what_the_tables_leave_out_has_mujocos_defaults) {
    mjOption defaults;
    mj_defaultOption(&defaults);
    for (const MujocoTask& task : mujoco_tasks) {
        for (const Physics physics : both_physics) {
            const MujocoEnvironment environment(task, physics);
            const mjModel& m = *environment.model;
            mjOption options = m.opt;
            CHECK_EQUAL(options.gravity[2], task.rules == Rules::maze2d ? 0 : -9.81);
            options.timestep = defaults.timestep;  // of the tables
            options.gravity[2] = defaults.gravity[2];
            options.integrator = defaults.integrator;
            options.iterations = defaults.iterations;
            CHECK(std::memcmp(&options, &defaults, sizeof options) == 0);
            for (int d = 0; d < m.nv; ++d) CHECK_EQUAL(m.dof_frictionloss[d], 0.0);
            for (int j = 0; j < m.njnt; ++j) CHECK(m.jnt_margin[j] == 0 && m.qpos_spring[m.jnt_qposadr[j]] == 0);
            for (int g = 0; g < m.ngeom; ++g)
                CHECK(m.geom_gap[g] == 0 && m.geom_solmix[g] == 1 && m.geom_priority[g] == 0);
            for (int a = 0; a < m.nu; ++a)
                CHECK(m.actuator_dyntype[a] == mjDYN_NONE && m.actuator_gaintype[a] == mjGAIN_FIXED &&
                      m.actuator_gainprm[a * mjNGAIN] == 1 && m.actuator_biastype[a] == mjBIAS_NONE &&
                      !m.actuator_forcelimited[a]);
            CHECK(m.nsensor == 0 && m.ntendon == 0 && m.neq == 0 && m.npair == 0 && m.nexclude == 0 && m.na == 0);
        }
    }
}

// Capsules of every body, halfcheetah's torso with two by parallel axes; density 1000, the ant's 5; halfcheetah is
// rescaled to 14 kg. Tensors are compared, not principal axes: any pair will do across a capsule.
TEST(inertials_follow_the_closed_form_of_either_physics) {
    for (const char* name : {"hopper", "walker2d", "halfcheetah", "ant", "antmaze-umaze", "maze2d-large"}) {
        for (const Physics physics : both_physics) {
            const MujocoEnvironment environment = make(name, physics);
            const mjModel& m = *environment.model;
            const double density = name[0] == 'a' ? 5 : 1000;
            double total = 0;
            for (int b = 1; b < m.nbody; ++b) total += inertial_by_hand(m, b, density, physics == Physics::d4rl).mass;
            const double scale = std::string_view(name) == "halfcheetah" ? 14 / total : 1;
            for (int b = 1; b < m.nbody; ++b) {
                const Inertial expected = inertial_by_hand(m, b, density * scale, physics == Physics::d4rl);
                std::array<double, 9> tensor{};
                add_rotated(tensor, m.body_iquat + 4 * b,
                            {m.body_inertia[3 * b], m.body_inertia[3 * b + 1], m.body_inertia[3 * b + 2]});
                CHECK_CLOSE(m.body_mass[b], expected.mass, 1e-13);
                CHECK_CLOSE(largest_difference({m.body_ipos + 3 * b, 3}, expected.centre), 0, 1e-13);
                CHECK_CLOSE(largest_difference(tensor, expected.tensor), 0, 1e-13);
            }
        }
    }
}

// What the compiler derives from the inertials and the solver weighs constraints with, at qpos0: the diagonal of M^-1,
// of J M^-1 J^T for each body's centre of mass (means over a body's three axes), and the mean of M's diagonal.
TEST(inverse_weights_follow_from_the_mass_matrix_in_either_physics) {
    for (const MujocoTask& task : mujoco_tasks) {
        for (const Physics physics : both_physics) {
            MujocoEnvironment environment(task, physics);
            const mjModel& m = *environment.model;
            mjData* d = environment.data.get();
            environment.start(initial(environment), still(environment));
            const auto compliance = [&](const Numbers& j) {  // j M^-1 j
                Numbers solved(j.size());
                mj_solveM(&m, d, solved.data(), j.data(), 1);
                return mju_dot(j.data(), solved.data(), m.nv);
            };
            Numbers full = zeros(m.nv * m.nv), of_dofs;
            mj_fullM(&m, full.data(), d->qM);
            double diagonal = 0;
            for (int i = 0; i < m.nv; ++i) {
                Numbers unit = still(environment);
                unit[static_cast<size_t>(i)] = 1;
                of_dofs.push_back(compliance(unit));
                diagonal += full[static_cast<size_t>(i * m.nv + i)];
            }
            if (m.jnt_type[0] == mjJNT_FREE)
                for (size_t i = 0; i < 6; i += 3)
                    of_dofs[i] = of_dofs[i + 1] = of_dofs[i + 2] = (of_dofs[i] + of_dofs[i + 1] + of_dofs[i + 2]) / 3;
            check_numbers("dof_invweight0", entries(0, m.dof_invweight0, m.nv), of_dofs);
            check_numbers("meaninertia", {m.stat.meaninertia}, {diagonal / m.nv});
            for (int b = 1; b < m.nbody; ++b) {
                Numbers jacobian = zeros(6 * m.nv);
                mj_jacBodyCom(&m, d, jacobian.data(), jacobian.data() + 3 * m.nv, b);
                Numbers expected(2);
                for (int axis = 0; axis < 6; ++axis)
                    expected[static_cast<size_t>(axis / 3)] +=
                        compliance({jacobian.begin() + axis * m.nv, jacobian.begin() + (axis + 1) * m.nv}) / 3;
                check_numbers("body_invweight0 of " + shown(b), entries(b, m.body_invweight0, 2), expected);
            }
        }
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// maze2d against its closed form.

// Semi-implicit Euler with implicit damping b = 1: (m + h b) a = F - b v. The corridor of row 3 is 6 cells long.
TEST(the_ball_moves_by_its_closed_form_between_walls) {
    MujocoEnvironment environment = make("maze2d-large");
    constexpr double h = 0.01, b = 1;
    Numbers x{3 - 0.2, 1 - 0.2}, v{0, 7};  // the first velocity is clipped too
    environment.start(x, v);
    int fast = 0;
    for (int t = 0; t < 100; ++t) {
        const Numbers action{t % 2 ? 0.3 : -0.3, t < 30 ? -0.9 : t < 75 ? 3.0 : -7.0};
        environment.advance(action);
        for (size_t i = 0; i < 2; ++i) {
            v[i] = std::clamp(v[i], -5.0, 5.0);
            v[i] += h * (100 * std::clamp(action[i], -1.0, 1.0) - b * v[i]) / (ball_mass + h * b);
            x[i] += h * v[i];
        }
        fast += v[1] > 5;
        CHECK_CLOSE(largest_difference(environment.observation, Numbers{x[0], x[1], v[0], v[1]}), 0, 1e-12);
    }
    CHECK(fast > 5);
    CHECK(x[1] < 6.2 && x[1] > 3);
}

// The free interval of a cell is [i - 0.7, i + 0.3] in observed coordinates; the ball's surface is 0.1 from its place.
TEST(a_wall_stops_the_ball_where_the_soft_contact_balances_the_push) {
    for (const double push : {1.0, 0.3}) {
        const double gap = 0.1 + distance_to_pushed_wall(100 * push);
        for (const MazeTable& maze : maze_tables) {
            MujocoEnvironment environment = make(maze.task);
            if (environment.task->rules != Rules::maze2d) continue;
            int walls = 0;
            for (const Cell& cell : cells(maze)) {
                if (cell.mark == '1') continue;
                for (const auto& [down, right] : {std::pair{1, 0}, {-1, 0}, {0, 1}, {0, -1}}) {
                    if (mark_at(maze, cell.row + down, cell.column + right) != '1') continue;
                    environment.start(Numbers{cell.row - 0.2, cell.column - 0.2}, Numbers(2));
                    for (int t = 0; t < 150; ++t) environment.advance(Numbers{down * push, right * push});
                    const Numbers expected{cell.row - 0.2 + down * (0.5 - gap), cell.column - 0.2 + right * (0.5 - gap),
                                           0, 0};
                    CHECK_CLOSE(largest_difference(environment.observation, expected), 0, 1e-9);
                    ++walls;
                }
            }
            CHECK(walls > 10);
        }
    }
}

TEST(the_place_on_the_map_is_a_whole_number_at_the_centre_of_a_cell) {
    for (const MazeTable& maze : maze_tables) {
        MujocoEnvironment environment = make(maze.task);
        const mjModel& m = *environment.model;
        Numbers qpos = initial(environment);
        int geom = 1;
        for (const Cell& cell : cells(maze)) {  // the body where a wall is: there the place on the map is the wall's
            if (cell.mark != '1') continue;
            qpos[0] = environment.task->rules == Rules::maze2d ? cell.row - 0.2 : 4.0 * (cell.column - 1);
            qpos[1] = environment.task->rules == Rules::maze2d ? cell.column - 0.2 : 4.0 * (cell.row - 1);
            environment.start(qpos, still(environment));
            CHECK_CLOSE(environment.data->xpos[3], m.geom_pos[3 * geom], 1e-12);
            CHECK_CLOSE(environment.data->xpos[4], m.geom_pos[3 * geom + 1], 1e-12);
            const MazePlace place = maze_place(*environment.task, qpos[0], qpos[1]);
            CHECK_CLOSE(place.row, cell.row, 1e-12);
            CHECK_CLOSE(place.column, cell.column, 1e-12);
            CHECK_CLOSE(2 * m.geom_size[3 * geom], maze_cell_length(*environment.task), 1e-12);
            ++geom;
        }
        const MujocoTask& task = *environment.task;
        const double length = maze_cell_length(task);  // a cell further is one further on the map, either way
        const MazePlace here = maze_place(task, 1, 2), there = maze_place(task, 1 + length, 2),
                        beyond = maze_place(task, 1, 2 + length);
        CHECK_CLOSE(std::fabs(there.row - here.row) + std::fabs(there.column - here.column), 1, 1e-12);
        CHECK_CLOSE(std::fabs(beyond.row - here.row) + std::fabs(beyond.column - here.column), 1, 1e-12);
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// Mechanics.

// Motors, joint dampers and limits act between parts of the robot, so in the air its centre of mass falls freely and
// its angular momentum stays. That is so of the exact motion; the integrator's error, as measured, goes with h^4, but
// with h^2 for the ant, whose quaternion Runge-Kutta turns by the mean velocity alone.
TEST(in_the_air_momentum_is_conserved_whatever_the_motors_do) {
    for (const char* name : {"hopper", "walker2d", "ant"}) {
        for (const Physics physics : both_physics) {
            MujocoEnvironment environment = make(name, physics);
            Dice dice;
            Numbers qpos = initial(environment), qvel = dice(environment.model->nv, -1, 1);
            const bool ant = environment.task->rules == Rules::ant;
            for (size_t i = 3; i < qpos.size(); ++i) qpos[i] = i % 3 == 2 ? 0 : -1;  // inside the joints' limits
            if (ant) qpos = Numbers{0, 0, 0.75, 0.5, 0.5, -0.5, 0.5, 0.1, 0.8, 0.1, -0.8, 0.1, -0.8, 0.1, 0.8};
            qpos[ant ? 2 : 1] = 5;
            environment.start(qpos, qvel);
            const Motion before = motion(environment);
            const int steps = ant ? 2 : 10;
            const Numbers action = dice(environment.task->action_dim, -0.02, 0.02);
            for (int t = 0; t < steps; ++t) environment.advance(action);
            const Motion after = motion(environment);
            const double seconds = steps * environment.step_time();
            Numbers centre = before.centre, velocity = before.velocity;
            for (size_t i = 0; i < 3; ++i) centre[i] += velocity[i] * seconds;
            centre[2] -= 9.81 / 2 * seconds * seconds;
            velocity[2] -= 9.81 * seconds;
            const double bound = ant ? 2e-6 : 1e-8;
            CHECK_CLOSE(largest_difference(after.velocity, velocity), 0, bound);
            CHECK_CLOSE(largest_difference(after.centre, centre), 0, bound);
            CHECK_CLOSE(largest_difference(after.spin, before.spin), 0, bound);
        }
    }
}

// The ant looks the same after a quarter turn and in the mirror y -> -y. Joint angles keep or change their sign with
// their axis: a turn takes ankle_1's axis (-1, 1, 0) to (-1, -1, 0), which is minus ankle_2's; a mirror image turns the
// other way about the mirrored axis.
struct AntSymmetry {
    std::array<size_t, 4> leg;  // where legs 1 to 4 come to lie, counted from 0
    std::array<double, 4> ankle;
    double hip;
    bool turn;

    Numbers vector(double x, double y, double z) const { return turn ? Numbers{-y, x, z} : Numbers{x, -y, z}; }
    Numbers spin(double x, double y, double z) const { return turn ? Numbers{-y, x, z} : Numbers{-x, y, -z}; }
    void legs(const Numbers& from, Numbers& to, size_t first) const {
        to.resize(from.size());
        for (size_t k = 0; k < 4; ++k) {
            to[first + 2 * leg[k]] = hip * from[first + 2 * k];
            to[first + 2 * leg[k] + 1] = ankle[k] * from[first + 2 * k + 1];
        }
    }
    Numbers qpos(const Numbers& q) const {
        Numbers to = vector(q[0], q[1], q[2]), turned = spin(q[4], q[5], q[6]);
        to.push_back(q[3]);
        to.insert(to.end(), turned.begin(), turned.end());
        legs(q, to, 7);
        return to;
    }
    Numbers qvel(const Numbers& v) const {
        Numbers to = vector(v[0], v[1], v[2]), turned = spin(v[3], v[4], v[5]);
        to.insert(to.end(), turned.begin(), turned.end());
        legs(v, to, 6);
        return to;
    }
    Numbers action(const Numbers& a) const {  // legs in the order 4, 1, 2, 3
        const Numbers in_order{a[2], a[3], a[4], a[5], a[6], a[7], a[0], a[1]};
        Numbers to;
        legs(in_order, to, 0);
        return {to[6], to[7], to[0], to[1], to[2], to[3], to[4], to[5]};
    }
};

TEST(a_turned_ant_and_a_mirrored_ant_move_alike) {
    const AntSymmetry symmetries[] = {{{1, 2, 3, 0}, {-1, 1, -1, 1}, 1, true}, {{3, 2, 1, 0}, {1, 1, 1, 1}, -1, false}};
    for (const AntSymmetry& symmetry : symmetries) {
        MujocoEnvironment one = make("ant"), other = make("ant");
        Dice dice;
        const Numbers qvel = dice(14, -0.3, 0.3),
                      qpos{0, 0, 0.5, 1, 0.1, -0.2, 0.3, 0.1, 0.8, -0.2, -0.9, 0.2, -0.8, -0.1, 1};
        one.start(qpos, qvel);
        other.start(symmetry.qpos(qpos), symmetry.qvel(qvel));
        int contacts = 0;
        for (int t = 0; t < 20; ++t) {
            const Numbers action = dice(8, -0.2, 0.2);
            const Step step = one.advance(action), step_of_other = other.advance(symmetry.action(action));
            CHECK_CLOSE(largest_difference(positions(other), symmetry.qpos(positions(one))), 0, 1e-11);
            CHECK_CLOSE(largest_difference(velocities(other), symmetry.qvel(velocities(one))), 0, 1e-11);
            if (!symmetry.turn) CHECK_CLOSE(step_of_other.reward, step.reward, 1e-11);
            contacts += one.data->ncon;
        }
        CHECK(contacts > 5);
    }
}

// Only the feet's friction tells left from right: 0.9 and 1.9.
TEST(walker2d_may_exchange_its_legs_in_the_air_but_not_on_the_floor) {
    const auto exchanged = [](Numbers x, int first) {
        std::rotate(x.begin() + first, x.begin() + first + 3, x.begin() + first + 6);
        return x;
    };
    for (const bool air : {true, false}) {
        MujocoEnvironment one = make("walker2d"), other = make("walker2d");
        Dice dice;
        const Numbers qpos{0, air ? 5.0 : 1.15, 0, -0.3, -0.5, 0.2, -0.6, -0.4, -0.3};
        Numbers qvel = dice(9, -0.5, 0.5);
        qvel[1] = -1;
        one.start(qpos, qvel);
        other.start(exchanged(qpos, 3), exchanged(qvel, 3));
        double apart = 0;
        for (int t = 0; t < 40; ++t) {
            const Numbers action = dice(6, -1, 1);
            one.advance(action);
            other.advance(exchanged(action, 0));
            apart = std::max(apart, largest_difference(positions(other), exchanged(positions(one), 3)));
        }
        if (air)
            CHECK_CLOSE(apart, 0, 1e-12);
        else
            CHECK(apart > 1e-3);
    }
}

TEST(at_rest_the_floor_carries_the_weight) {
    for (const Physics physics : both_physics) {
        for (const char* name : {"halfcheetah", "ant"}) {
            MujocoEnvironment environment = make(name, physics);
            environment.start(initial(environment), still(environment));
            const Numbers action = zeros(environment.task->action_dim);
            for (int t = 0; t < 400; ++t) environment.advance(action);
            double carried = 0;
            for (int c = 0; c < environment.data->ncon; ++c) {
                double force[6];
                mj_contactForce(environment.model.get(), environment.data.get(), c, force);
                carried += force[0];  // along the normal, upwards
            }
            CHECK_CLOSE(carried, 9.81 * mj_getTotalmass(environment.model.get()), 1e-6);
            if (environment.task->rules == Rules::halfcheetah) CHECK_CLOSE(carried, 9.81 * 14, 1e-6);
        }
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// Step, observation, reward.

TEST(rewards_are_the_sum_of_their_parts) {
    const struct {
        const char* name;
        double seconds, alive, cost;
    } tasks[] = {{"hopper", 4 * 0.002, 1, 0.001},
                 {"walker2d", 4 * 0.002, 1, 0.001},
                 {"halfcheetah", 5 * 0.01, 0, 0.1},
                 {"ant", 5 * 0.01, 1, 0.5}};
    for (const auto& [name, seconds, alive, cost] : tasks) {
        MujocoEnvironment environment = make(name);
        const bool ant = environment.task->rules == Rules::ant;
        const auto place = [&] { return ant ? environment.data->xpos[3] : environment.data->qpos[0]; };  // of body 1
        reset(environment, 0);
        Dice dice;
        double by_qpos = 0;  // how far the reward would be off with qpos for xpos
        for (int t = 0; t < 30; ++t) {
            const Numbers action = dice(environment.task->action_dim, -1.5, 1.5);  // a third is clipped
            const double before = place(), qpos_before = environment.data->qpos[0];
            const Step step = environment.advance(action);
            double squares = 0;
            for (const double a : action) squares += std::min(a * a, 1.0);
            const double forward = (place() - before) / seconds;
            CHECK_CLOSE(step.reward, forward + alive - cost * squares, 1e-12);
            by_qpos = std::max(by_qpos, std::fabs((environment.data->qpos[0] - qpos_before) / seconds - forward));
        }
        CHECK_EQUAL(by_qpos > 1e-4, ant);
    }
}

TEST(an_action_beyond_its_bounds_is_the_bound_and_reaches_the_motors_in_their_range) {
    for (const MujocoTask& task : mujoco_tasks) {
        MujocoEnvironment one(task, Physics::d4rl), other(task, Physics::d4rl);
        Dice dice;
        for (int t = 0; t < 20; ++t) {
            const Numbers action = dice(task.action_dim, -2, 2);
            Numbers clipped = action;
            for (double& a : clipped) a = std::clamp(a, -1.0, 1.0);
            const Step step = one.advance(action), step_of_other = other.advance(clipped);
            CHECK(positions(one) == positions(other) && velocities(one) == velocities(other));
            CHECK_EQUAL(step.reward, step_of_other.reward);
            for (size_t i = 0; i < clipped.size(); ++i)
                CHECK_CLOSE(one.data->ctrl[i], clipped[i] * (task.rules == Rules::antmaze ? 30 : 1), 1e-14);
        }
    }
}

TEST(step_is_advance_in_single_precision) {
    for (const MujocoTask& task : mujoco_tasks) {
        MujocoEnvironment one(task, Physics::d4rl), other(task, Physics::d4rl);
        const std::vector<float> action(one.control.size(), 0.3f);
        std::vector<float> state(one.observation.size());
        const Step step = one.step(action.data(), state.data());
        const Step step_of_other = other.advance(Numbers(action.begin(), action.end()));
        CHECK(one.observation == other.observation && step.reward == step_of_other.reward);
        CHECK(state == std::vector<float>(one.observation.begin(), one.observation.end()));
    }
}

// Bit by bit. maze2d first brings the engine up to date under the old control, which in a corner shows in the last
// digits.
TEST(an_action_lasts_its_number_of_engine_steps_and_nothing_follows_them) {
    for (const MujocoTask& task : mujoco_tasks) {
        const bool planar_walker = task.rules == Rules::hopper || task.rules == Rules::walker2d;
        const int engine_steps = task.rules == Rules::maze2d ? 1 : planar_walker ? 4 : 5;
        MujocoEnvironment environment(task, Physics::d4rl);
        if (task.rules == Rules::maze2d) environment.start(Numbers{0.42, 0.42}, Numbers{-1, -1});  // into a corner
        MujocoEnvironment plain = environment;
        Dice dice;
        for (int t = 0; t < 20; ++t) {
            const Numbers action = dice(task.action_dim, -1, 1);
            environment.advance(action);
            if (task.rules == Rules::maze2d) mj_forward(plain.model.get(), plain.data.get());  // under the old control
            std::copy(environment.control.begin(), environment.control.end(), plain.data->ctrl);
            for (int i = 0; i < engine_steps; ++i) mj_step(plain.model.get(), plain.data.get());
            CHECK(positions(environment) == positions(plain) && velocities(environment) == velocities(plain));
            CHECK(std::equal(plain.data->xpos, plain.data->xpos + 6, environment.data->xpos));
        }
    }
}

TEST(observations_are_positions_then_velocities_clipped_for_hopper_and_walker2d_alone) {
    for (const MujocoTask& task : mujoco_tasks) {
        MujocoEnvironment environment(task, Physics::d4rl);
        const bool clips = task.rules == Rules::hopper || task.rules == Rules::walker2d;
        const int first = task.rules == Rules::ant ? 2 : clips || task.rules == Rules::halfcheetah ? 1 : 0;
        Numbers qpos = initial(environment), qvel = still(environment);
        for (size_t i = 0; i < qvel.size(); ++i)
            qvel[i] = (i % 2 ? -1 : 1) * (9.0 + static_cast<double>(i));  // 9, -10, 11, ...
        environment.start(qpos, qvel);
        Numbers expected(qpos.begin() + first, qpos.end());
        for (const double v : qvel) expected.push_back(clips ? std::clamp(v, -10.0, 10.0) : v);
        if (task.rules == Rules::ant) expected.resize(expected.size() + 84);
        CHECK(environment.observation == expected);
    }
}

TEST(the_84_contact_forces_of_the_ant_are_zero_in_contact_too) {
    MujocoEnvironment environment = make("ant");
    int contacts = 0;
    for (int t = 0; t < 60; ++t) {
        environment.advance(Numbers(8));
        contacts += environment.data->ncon;
        for (size_t i = 27; i < 111; ++i) CHECK_EQUAL(environment.observation[i], 0.0);
    }
    CHECK(contacts > 50);
    mj_rnePostConstraint(environment.model.get(), environment.data.get());
    environment.observe();
    CHECK(*std::ranges::max_element(environment.observation) == 1.0);  // what they would be, clipped
}

TEST(maze2d_pays_one_within_half_a_metre_of_the_goal_and_goes_on) {
    const struct {
        const char* name;
        Numbers goal;
        double towards;  // the free neighbour cell, along y
    } mazes[] = {{"maze2d-umaze", {1, 1}, 1}, {"maze2d-medium", {6, 6}, -1}, {"maze2d-large", {7, 9}, 1}};
    for (const auto& [name, goal, towards] : mazes) {
        MujocoEnvironment environment = make(name);
        reset(environment, 3);
        CHECK(environment.goal[0] == goal[0] && environment.goal[1] == goal[1]);
        for (const double distance : {0.0, 0.5, 0.5 + 1e-9}) {
            environment.start(Numbers{goal[0], goal[1] + towards * distance}, Numbers(2));
            for (int t = 0; t < 3; ++t) {
                const Step step = environment.advance(Numbers(2));
                CHECK(step.reward == (distance <= 0.5 ? 1 : 0) && !step.terminated);
            }
        }
        environment.start(Numbers{goal[0], goal[1] + towards * 0.495}, Numbers{0, towards});  // leaves within the step
        CHECK_EQUAL(environment.advance(Numbers(2)).reward, 0.0);
        environment.start(Numbers{goal[0], goal[1] + towards * 0.505}, Numbers{0, -towards});
        CHECK_EQUAL(environment.advance(Numbers(2)).reward, 1.0);
    }
}

TEST(antmaze_pays_one_and_ends_within_half_a_metre_of_the_goal) {
    MujocoEnvironment environment = make("antmaze-umaze");
    CHECK(environment.goal[0] == 0 && environment.goal[1] == 8);  // before any reset: the cell's centre
    environment.goal = {0.75, 8.5};
    Numbers qpos = initial(environment);
    for (const double angle : {0.0, 1.0, 2.5, 4.0}) {
        for (const double distance : {0.0, 0.5 - 1e-9, 0.5 + 1e-9, 1.0}) {
            qpos[0] = 0.75 + distance * std::cos(angle);
            qpos[1] = 8.5 + distance * std::sin(angle);
            environment.start(qpos, still(environment));
            CHECK_EQUAL(environment.terminated(), distance < 0.5);
            CHECK_EQUAL(environment.reward(0), distance < 0.5 ? 1.0 : 0.0);
        }
    }
    Numbers qvel = still(environment);
    for (const double direction : {-1.0, 1.0}) {  // at 3 m/s a step, 0.1 s, leads in or out
        qpos[0] = 0.75;
        qpos[1] = 8.5 + 0.5 - direction * 0.1;
        qvel[1] = 3 * direction;
        environment.start(qpos, qvel);
        CHECK_EQUAL(environment.terminated(), direction > 0);
        const Step step = environment.advance(Numbers(8));
        CHECK_EQUAL(step.reward, direction < 0 ? 1.0 : 0.0);
        CHECK_EQUAL(step.terminated, direction < 0);
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// Terminations.

TEST(episodes_end_on_the_right_side_of_every_threshold) {
    constexpr double e = 1e-9;
    struct Threshold {
        const char* name;
        char vector;  // q or v
        size_t index;
        Numbers goes_on, ends;
    };
    std::vector<Threshold> thresholds{
        {"hopper", 'q', 0, {-1000, 1000}, {}},
        {"hopper", 'q', 1, {0.7 + e, 150}, {0.7, 0.7 - e}},
        {"hopper", 'q', 2, {0.2 - e, -0.2 + e}, {0.2, 0.2 + e, -0.2, -0.2 - e}},
        {"walker2d", 'q', 1, {0.8 + e, 2 - e}, {0.8, 0.8 - e, 2, 2 + e}},
        {"walker2d", 'q', 2, {1 - e, -1 + e}, {1, 1 + e, -1, -1 - e}},
        {"walker2d", 'q', 4, {-200, 200}, {}},
        {"walker2d", 'v', 3, {-1000, 1000}, {}},
        {"ant", 'q', 2, {0.2, 0.2 + e, 1 - e, 1}, {0.2 - e, 1 + e}},
        {"ant", 'v', 3, {-1000, 1000}, {}},
        {"halfcheetah", 'q', 1, {-0.6, 5}, {}},
        {"halfcheetah", 'q', 2, {-3.14, 3.14}, {}},
        {"halfcheetah", 'v', 4, {-1000, 1000}, {}},
        {"antmaze-umaze", 'q', 2, {0.1, 5}, {}},
        {"antmaze-umaze-diverse", 'q', 2, {0.1, 5}, {}},
        {"maze2d-umaze", 'v', 0, {-1000, 1000}, {}},
        {"maze2d-large", 'q', 0, {-0.5, 7}, {}},
    };
    for (const auto& [vector, first] : {std::pair{'q', 3}, {'v', 0}})
        for (size_t i = static_cast<size_t>(first); i < 6; ++i)
            thresholds.push_back({"hopper", vector, i, {100 - e, -100 + e}, {100, 100 + e, -100, -100 - e}});
    for (const Threshold& threshold : thresholds) {
        MujocoEnvironment environment = make(threshold.name);
        const auto check = [&](double value, bool ends) {
            Numbers qpos = initial(environment), qvel = still(environment);
            (threshold.vector == 'q' ? qpos : qvel)[threshold.index] = value;
            environment.start(qpos, qvel);
            if (environment.terminated() != ends)
                report_failure(__FILE__, __LINE__,
                               std::string(threshold.name) + ": " + threshold.vector + shown(threshold.index) + " = " +
                                   shown(value) + (ends ? " does not end" : " ends") + " the episode");
        };
        for (const double value : threshold.goes_on) check(value, false);
        for (const double value : threshold.ends) check(value, true);
    }
    // What is not a number ends an episode of those that look at it. It is written past start(): the engine would
    // reset.
    for (const auto& [name, ends] : std::initializer_list<std::pair<const char*, bool>>{
             {"hopper", true}, {"walker2d", true}, {"ant", true}, {"halfcheetah", false}}) {
        MujocoEnvironment environment = make(name);
        CHECK(!environment.terminated());
        environment.data->qpos[environment.task->rules == Rules::ant ? 9 : 1] = NAN;
        CHECK_EQUAL(environment.terminated(), ends);
    }
    for (const bool velocity : {false, true}) {
        MujocoEnvironment environment = make("ant");
        (velocity ? environment.data->qvel : environment.data->qpos)[0] = INFINITY;
        CHECK(environment.terminated());
        MujocoEnvironment hopper = make("hopper");
        (velocity ? hopper.data->qvel : hopper.data->qpos)[0] = INFINITY;
        CHECK(hopper.terminated());
    }
}

// Entry 2 is the pitch of hopper and walker2d and the ant's height; it passes its threshold within the step.
TEST(the_step_that_ends_an_episode_pays_the_bonus_too) {
    for (const auto& [name, value] : {std::pair{"hopper", 0.199}, {"walker2d", 0.999}, {"ant", 0.999}}) {
        MujocoEnvironment environment = make(name);
        Numbers qpos = initial(environment), qvel = still(environment);
        qpos[2] = value;
        qvel[2] = 1;
        environment.start(qpos, qvel);
        CHECK(!environment.terminated());
        const double before = environment.x_position();
        const Step step = environment.advance(zeros(environment.task->action_dim));
        CHECK(step.terminated);
        CHECK_CLOSE(step.reward, (environment.x_position() - before) / environment.step_time() + 1, 1e-12);
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// Resets.

TEST(resets_have_the_documented_distributions) {
    constexpr uint64_t resets = 4000;
    for (const MujocoTask& task : mujoco_tasks) {
        if (task.rules == Rules::maze2d) continue;
        MujocoEnvironment environment(task, Physics::d4rl);
        const bool normal = task.rules != Rules::hopper && task.rules != Rules::walker2d;
        const bool has_quaternion = environment.model->nq > environment.model->nv;
        const double noise = normal ? 0.1 : 0.005;
        const Numbers start = initial(environment);
        std::vector<Sample> of_qpos(start.size()), of_qvel(still(environment).size());
        for (uint64_t episode = 0; episode < resets; ++episode) {
            reset(environment, episode);
            for (size_t i = 0; i < of_qpos.size(); ++i) of_qpos[i].add(environment.data->qpos[i] - start[i]);
            for (size_t i = 0; i < of_qvel.size(); ++i) of_qvel[i].add(environment.data->qvel[i]);
            if (!has_quaternion) continue;
            const double* seen = environment.observation.data() + 3 - task.first_position;  // already normalised
            CHECK_CLOSE(mju_norm(seen, 4), 1, 1e-14);
            for (int i = 1; i < 4; ++i) CHECK(std::fabs(seen[i] / seen[0]) <= 0.1 / 0.9);
        }
        for (size_t i = 0; i < of_qpos.size(); ++i) {
            if (has_quaternion && i == 3) continue;
            if (has_quaternion && i > 3 && i < 7) {  // uniform(-0.1, 0.1), divided by a length of 1 +- 0.06
                CHECK_CLOSE(of_qpos[i].mean(), 0, 0.0577 * 5 / std::sqrt(resets));
                CHECK_CLOSE(std::sqrt(of_qpos[i].variance()), 0.0577, 0.003);
            } else {
                check_uniform(of_qpos[i], -noise, noise);
            }
        }
        for (const Sample& sample : of_qvel) normal ? check_normal(sample, 0.1) : check_uniform(sample, -noise, noise);
    }
}

TEST(maze2d_starts_in_every_free_cell_and_at_the_goal_alike) {
    for (const MazeTable& maze : maze_tables) {
        MujocoEnvironment environment = make(maze.task);
        if (environment.task->rules != Rules::maze2d) continue;
        std::map<std::pair<int, int>, int> counts;
        for (const Cell& cell : cells(maze))
            if (cell.mark != '1') counts[{cell.row, cell.column}] = 0;
        const size_t free_cells = counts.size(), resets = 200 * free_cells;
        CHECK_EQUAL(free_cells, cells(maze).size() - static_cast<size_t>(maze.walls));
        Sample away[2], velocity[2];
        for (uint64_t episode = 0; episode < resets; ++episode) {
            reset(environment, episode);
            const Numbers& at = environment.observation;
            ++counts[{static_cast<int>(std::round(at[0])), static_cast<int>(std::round(at[1]))}];
            for (size_t i = 0; i < 2; ++i) away[i].add(at[i] - std::round(at[i])), velocity[i].add(at[2 + i]);
        }
        CHECK_EQUAL(counts.size(), free_cells);  // no other cell came up
        double chi_square = 0;
        for (const auto& [cell, count] : counts) chi_square += (count - 200.0) * (count - 200.0) / 200;
        const double freedom = static_cast<double>(free_cells) - 1;
        CHECK(chi_square < freedom + 5 * std::sqrt(2 * freedom) && chi_square > freedom / 20);
        for (size_t i = 0; i < 2; ++i) {
            check_uniform(away[i], -0.1 - 1e-12, 0.1 + 1e-12);
            check_normal(velocity[i], 0.1);
        }
    }
}

// Each of x and y: the centre (0, 8) plus uniform(0, 1) plus uniform(0, 0.5); below a quarter with 0.25^2 / (2 * 0.5).
TEST(antmaze_draws_its_goal_anew_at_every_reset) {
    constexpr uint64_t resets = 4000;
    for (const char* name : {"antmaze-umaze", "antmaze-umaze-diverse"}) {
        MujocoEnvironment environment = make(name);
        std::set<std::array<double, 2>> goals;
        Sample of[2], product, below_quarter;
        for (uint64_t episode = 0; episode < resets; ++episode) {
            reset(environment, episode);
            const double x = environment.goal[0], y = environment.goal[1] - 8;
            goals.insert(environment.goal);
            of[0].add(x), of[1].add(y);
            product.add((x - 0.75) * (y - 0.75));
            below_quarter.add(x < 0.25);
        }
        CHECK_EQUAL(goals.size(), size_t{resets});
        for (const Sample& sample : of) {
            CHECK(sample.low >= 0 && sample.low < 0.1 && sample.high < 1.5 && sample.high > 1.4);
            CHECK_CLOSE(sample.mean(), 0.75, 5 * sample.standard_error());
            CHECK_CLOSE(sample.variance(), (1 + 0.25) / 12, 0.01);
        }
        CHECK_CLOSE(product.mean(), 0, 5 * product.standard_error());
        CHECK_CLOSE(below_quarter.mean(), 0.0625, 5 * below_quarter.standard_error());
    }
}

TEST(an_episode_is_a_function_of_its_seed_its_number_and_its_actions) {
    for (const MujocoTask& task : mujoco_tasks) {
        const auto play = [&](MujocoEnvironment& environment, int steps, Dice dice = {}) {
            Numbers trace(environment.observation);
            trace.insert(trace.end(), environment.goal.begin(), environment.goal.end());
            for (int t = 0; t < steps; ++t) {
                trace.push_back(environment.advance(dice(task.action_dim, -1, 1)).reward);
                trace.insert(trace.end(), environment.observation.begin(), environment.observation.end());
            }
            return trace;
        };
        MujocoEnvironment fresh(task, Physics::d4rl), used(task, Physics::d4rl);
        reset(fresh, 5);
        const Numbers start = fresh.observation, expected = play(fresh, 40);

        reset(used, 6);  // another episode, left in mid-air
        CHECK(used.observation != start && (task.rules != Rules::antmaze || used.goal != fresh.goal));
        play(used, 15);
        reset(used, 5);
        CHECK_EQUAL(used.steps, 0);
        CHECK(play(used, 40) == expected);
        reset(used, 5, test_seed() + 1);
        CHECK(used.observation != start);

        reset(used, 5);  // a copy in mid-episode goes on as the original, and on its own
        play(used, 20);
        MujocoEnvironment copy = used;
        const Numbers going_on = play(copy, 20, Dice{7});
        CHECK_EQUAL(copy.steps, 40);
        CHECK_EQUAL(used.steps, 20);
        CHECK(play(used, 20, Dice{7}) == going_on);
    }
}

TEST(a_random_trajectory_replays_step_by_step) {
    for (const char* name : {"hopper", "maze2d-medium", "ant"}) {
        MujocoEnvironment environment = make(name);
        const auto trajectory = random_trajectory(environment, test_seed(), 2);
        CHECK(trajectory.has_value());
        if (!trajectory) continue;
        const size_t states = environment.observation.size(), actions = environment.control.size();
        const size_t steps = trajectory->rewards.size();
        CHECK(trajectory->states.size() == steps * states && trajectory->actions.size() == steps * actions);
        CHECK(trajectory->terminated || trajectory->length() == environment.task->max_episode_steps);
        Sample sample;
        for (const float a : trajectory->actions) sample.add(static_cast<double>(a));
        check_uniform(sample, -1, 1);
        std::vector<float> state(states);
        environment.reset(Random{test_seed(), Stream::environment}, data_set_episodes + 2, state.data());
        for (size_t t = 0; t < steps; ++t) {
            CHECK(std::equal(state.begin(), state.end(), trajectory->states.data() + t * states));
            const Step step = environment.step(trajectory->actions.data() + t * actions, state.data());
            CHECK_EQUAL(trajectory->rewards[t], static_cast<float>(step.reward));
            CHECK_EQUAL(step.terminated, trajectory->terminated && t + 1 == steps);
        }
    }
}

// ---------------------------------------------------------------------------------------------------------------------
// Errors.

TEST(an_action_that_is_not_finite_is_an_error) {
    for (const MujocoTask& task : mujoco_tasks) {
        MujocoEnvironment environment(task, Physics::d4rl);
        const Numbers before = environment.observation;
        for (const double bad : {NAN, INFINITY, -INFINITY}) {
            for (size_t i = 0; i < static_cast<size_t>(task.action_dim); ++i) {
                Numbers action = zeros(task.action_dim);
                action[i] = bad;
                CHECK_FAILS("mujoco.bad_action", environment.advance(action));
            }
        }
        CHECK(environment.observation == before && environment.steps == 0);
    }
}

// The engine calls its error handler where memory ends; the exception passes through its functions.
TEST(a_simulation_without_memory_is_an_error_and_the_next_one_works) {
    const MujocoEnvironment environment = make("hopper");
    mju_user_malloc = [](size_t) -> void* { return nullptr; };
    CHECK_FAILS("mujoco.engine", environment.clone());
    mju_user_malloc = nullptr;
    CHECK_FAILS("mujoco.memory", own_state(nullptr));
    std::vector<float> action(3, 0.5f), state(11), expected(11);
    MujocoEnvironment other = environment;
    other.step(action.data(), expected.data());
    environment.clone()->step(action.data(), state.data());
    CHECK(state == expected);
}

TEST(what_the_engine_warns_of_is_an_error_that_names_task_and_step) {
    const Listener quiet;
    for (const MujocoTask& task : mujoco_tasks) {
        MujocoEnvironment environment(task, Physics::d4rl);
        const Numbers action = zeros(task.action_dim);
        environment.advance(action);
        environment.advance(action);
        environment.data->qvel[environment.model->nv - 1] = 1e12;
        if (task.rules == Rules::maze2d) environment.data->qpos[0] = 1e12;  // its velocity is clipped first
        try {
            environment.advance(action);
            CHECK(!"an error");
        } catch (const Error& error) {
            CHECK_EQUAL(error.id, "environment.unstable");
            const std::string number = task.rules == Rules::maze2d
                                           ? "qpos at DOF 0"
                                           : "qvel at DOF " + std::to_string(environment.model->nv - 1);
            CHECK_EQUAL(std::string(error.what()),
                        std::string(task.name) + ": step 3: MuJoCo: bad number in " + number);
        }
        environment.start(initial(environment), still(environment));  // and the next episode is sound
        environment.advance(action);
        CHECK_EQUAL(environment.steps, 1);
    }
}

TEST(an_error_of_the_engine_is_an_error_of_ours_and_nothing_is_printed) {
    const Listener quiet;
    const MujocoEnvironment environment = make("hopper");
    CHECK_FAILS("mujoco.engine", mju_error("x"));
    CHECK_FAILS("mujoco.engine", mj_stackAlloc(environment.data.get(), 1 << 30));  // from inside the library
    mju_warning("y");
}

// ---------------------------------------------------------------------------------------------------------------------
// The published data.

// D4RL's walker2d-random-v2: 10^6 steps of a uniformly random policy in 48908 episodes, mean return 1.871. The masses
// of MuJoCo 2.2 make episodes longer by 0.64 steps. Hopper and ant cannot tell the two apart, walker2d can. The seed is
// fixed: of seeds 1 to 60, three put one of the four means on the wrong side of its bound.
TEST(random_walkers_fall_as_in_d4rls_data_with_the_masses_of_its_time_alone) {
    constexpr uint32_t seed = 1;
    struct Result {
        Sample length, total;
    };
    const auto play = [](MujocoEnvironment environment, uint64_t episodes) {
        Result result;
        for (uint64_t episode = 0; episode < episodes; ++episode) {
            const auto trajectory = random_trajectory(environment, seed, episode);
            if (!trajectory) continue;
            result.length.add(trajectory->length());
            result.total.add(std::accumulate(trajectory->rewards.begin(), trajectory->rewards.end(), 0.0));
        }
        return result;
    };
    const auto shown_beside = [](const char* physics, const Result& r) {
        std::printf(
            "  masses of %s, seed %u, %.0f episodes: length %.3f +- %.3f (D4RL 20.447), return %.3f +- %.3f (D4RL 1.871)\n",
            physics, seed, r.length.count, r.length.mean(), r.length.standard_error(), r.total.mean(),
            r.total.standard_error());
    };
    // More of the second: it is to miss by 3 standard errors, and is expected to miss by 5.3.
    auto second = std::async(std::launch::async, play, make("walker2d", Physics::mujoco_2_2), 5000);
    const Result then = play(make("walker2d", Physics::d4rl), 3000), now = second.get();
    shown_beside("MuJoCo 2.1.0", then);
    shown_beside("MuJoCo 2.2", now);
    CHECK(then.length.count >= 2990 && now.length.count >= 4990);  // the engine spoils next to none
    CHECK_CLOSE(then.length.mean(), 20.447, 3 * then.length.standard_error());
    CHECK_CLOSE(then.total.mean(), 1.871, 3 * then.total.standard_error());
    CHECK(now.length.mean() > 20.447 + 3 * now.length.standard_error());
    CHECK(now.total.mean() > 1.871 + 3 * now.total.standard_error());
}

#else

TEST(mujoco_is_not_installed) { std::printf("MuJoCo is not installed: its tests did not run\n"); }

#endif
