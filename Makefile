# WODTEM: a reference implementation in one binary. Needs g++ (12 or newer) and, for all tasks but the grid world, MuJoCo
# 2.2; both are installed with apt where they are missing. Without MuJoCo the grid world still builds.
#
#   make run              build, train DT, ODT and WODTEM on the grid world (about a minute), show the report
#   make test             build and run every test; the last line is "N passed, N failed"
#   make                  build ./wodtem alone
#   make paper-gridworld  the paper's grid world as printed (width 512), five seeds of each method; hours, resumable
#   make sanitize         every test under AddressSanitizer and UndefinedBehaviorSanitizer, the threads under ThreadSanitizer
#   make map              the map from the paper's equations to code, tests and vectors
#   make mutants          which of some 390 one-line mistakes the golden vectors and the tests find; 15 minutes and more
#   make faults           every call of the system and every allocation of eight commands made to fail; FAST=1: a few
#   make fuzz             inputs made by libFuzzer for everything that is read, SECONDS=20 for each target; needs clang 19
#   make endure           runs killed KILLS=500 times and continued, by 1 to 8 threads, and watched for growth
#   make coverage         lines and branches that the tests reach; needs clang 19
#   make bench            the machine's peak, each kernel's share of it, update and look-up times
#   make format           lay out the sources with clang-format
#   make clean            remove what was built (runs/ stays)

CXX = g++
# -O2 with loops in vectors, peeled and unswitched: as fast as -O3, and compiled sooner (tests/BENCH.md); wodtem.cpp
# lowers it for what takes little time. No result depends on the level.
# -ffp-contract=off: one rounding an operation everywhere but in the kernels that say otherwise.
# -Wno-restrict: GCC 12 warns about memcpy inside std::string that cannot happen (GCC bug 105651).
# -fno-math-errno: a square root is an instruction.
CXXFLAGS = -std=c++20 -O2 -fvect-cost-model=dynamic -fpeel-loops -funswitch-loops -pthread \
           -ffp-contract=off -fno-math-errno \
           -Wall -Wextra -Wpedantic -Wconversion -Wshadow -Wno-restrict -Werror
HEADERS = $(wildcard *.hpp data/*.hpp data/*.xml data/policies/* tests/*.hpp tests/fuzz.cpp)
# Asked when it is needed, after `packages`.
LIBRARIES = $(shell $(CXX) -E -x c++ -include mujoco/mujoco.h /dev/null >/dev/null 2>&1 && echo -lmujoco)
# What --version and seconds.csv say; "-dirty" where the sources differ from the commit, nothing outside of a checkout.
COMMIT = $(shell git describe --always --dirty --exclude '*' 2>/dev/null)
TESTS = $(patsubst tests/%.cpp,%,tests/main.cpp $(wildcard tests/test_*.cpp))
SOURCES = $(wildcard *.hpp *.cpp data/*.hpp tests/*.hpp tests/*.cpp)

# -flto=auto: one source file, but its functions are compiled by as many processes as there are cores.
wodtem: wodtem.cpp $(HEADERS) | packages
	$(CXX) $(CXXFLAGS) -flto=auto -DWODTEM_COMMIT='"$(COMMIT)"' $< -o $@ $(LIBRARIES)

# A fresh Debian has apt and make alone. Without g++ nothing can be built, without MuJoCo everything but its tasks. What
# is about to be installed is said first, with the command to do it by hand.
ROOT = $$(test "$$(id -u)" = 0 || echo sudo -n)
INSTALL = install() { echo "$$1 is missing; installing it: apt-get install $$1 (as root, or by sudo)"; \
	  $(ROOT) apt-get update -qq && $(ROOT) apt-get install -y -qq $$1; }
packages:
	@$(INSTALL); command -v $(CXX) >/dev/null || install g++
	@$(INSTALL); test "$(LIBRARIES)" || install libmujoco-dev || \
	  echo "MuJoCo 2.2 is missing: only the grid world is built; for the rest: apt-get install libmujoco-dev, make clean, make"

run: wodtem
	@echo "Training DT, ODT and WODTEM on the 6x6 grid world (preset small, seed 0); the shortest path has 5 steps."
	@./wodtem train gridworld --methods dt,odt,wodtem --seed 0 --preset small
	@./wodtem report runs/gridworld-small-dt-0 runs/gridworld-small-odt-0 runs/gridworld-small-wodtem-0

paper-gridworld: wodtem
	./wodtem sweep gridworld --preset paper --seeds 0-4 --estimate
	./wodtem sweep gridworld --preset paper --seeds 0-4 | sh -e
	./wodtem report --out runs/report-paper runs/gridworld-paper-*

# One object per test file, so that make -j helps; test_wodtem.cpp includes wodtem.cpp. -O1 compiles fastest.
build/%.o: tests/%.cpp wodtem.cpp $(HEADERS) | packages
	@mkdir -p build
	$(CXX) $(CXXFLAGS) -O1 -c $< -o $@

build/tests: $(TESTS:%=build/%.o)
	$(CXX) $(CXXFLAGS) $^ -o $@ $(LIBRARIES)

test: wodtem build/tests
	build/tests

# The link keeps the first of equal functions. First stands what has all checks: the tests of what reads bytes (-Og), and
# of the memory and the network (-O1). Then what computes besides, without checks of each pointer, which take a third of
# the compilation: an access through a null pointer, or outside of an object, AddressSanitizer finds; nothing is virtual.
FEWER_CHECKS = -O1 -fno-sanitize=null,alignment,object-size,vptr
COMPUTING = test_wodtem test_mujoco test_sac test_collect test_waypoints
LINKED_FIRST = test_hdf5 test_data test_memory test_nn $(COMPUTING)
build/san-%.o: tests/%.cpp wodtem.cpp $(HEADERS) | packages
	@mkdir -p build
	$(CXX) $(CXXFLAGS) -Og -fsanitize=address,undefined -fno-sanitize-recover=all $(CHECKS) -c $< -o $@
$(COMPUTING:%=build/san-%.o): CHECKS = $(FEWER_CHECKS)
build/san-test_nn.o build/san-test_memory.o: CHECKS = -O1

build/tests-sanitized: $(patsubst %,build/san-%.o,$(LINKED_FIRST) $(filter-out $(LINKED_FIRST),$(TESTS)))
	$(CXX) $(CXXFLAGS) -fsanitize=address,undefined $^ -o $@ $(LIBRARIES)

build/tests-threads: tests/main.cpp tests/test_nn.cpp tests/test_wodtem.cpp wodtem.cpp $(HEADERS) | packages
	@mkdir -p build
	$(CXX) $(CXXFLAGS) -O1 -fsanitize=thread tests/main.cpp tests/test_nn.cpp tests/test_wodtem.cpp -o $@ $(LIBRARIES)

sanitize: wodtem build/tests-sanitized build/tests-threads
	build/tests-threads threads number_of_threads
	build/tests-sanitized

map:
	@mkdir -p build
	@$(CXX) -std=c++20 -O1 -DPRINT_MAP tests/test_map.cpp -o build/map
	@build/map

mutants: | packages
	@sh tests/mutants.sh

faults: wodtem
	@sh tests/faults.sh

# clang 19 of Debian 12: libFuzzer, and branches counted by the conditions of the source.
CLANG = clang++-19
CLANGFLAGS = -std=c++20 -O1 -g1 -w -pthread -ffp-contract=off -fno-math-errno
clang: | packages
	@$(INSTALL); command -v $(CLANG) >/dev/null || install clang-19
	@$(INSTALL); command -v llvm-cov-19 >/dev/null || install llvm-19

build/fuzz/fuzz: tests/fuzz.sh wodtem.cpp $(HEADERS) | clang
	sh tests/fuzz.sh build $(CLANG) $(CLANGFLAGS) $(LIBRARIES)

SECONDS = 20
fuzz: wodtem build/fuzz/fuzz
	@sh tests/fuzz.sh run $(SECONDS) $(TARGETS)

endure: wodtem
	@sh tests/endure.sh

build/coverage-%.o: tests/%.cpp wodtem.cpp $(HEADERS) | clang
	@mkdir -p build
	$(CLANG) $(CLANGFLAGS) -fprofile-instr-generate -fcoverage-mapping -c $< -o $@

build/tests-coverage: $(TESTS:%=build/coverage-%.o)
	$(CLANG) -pthread -fprofile-instr-generate $^ -o $@ $(LIBRARIES)

# What the program does as a process of its own, started by a test, is not counted.
coverage: wodtem build/tests-coverage
	LLVM_PROFILE_FILE=build/coverage.profraw build/tests-coverage | tail -n 1
	@llvm-profdata-19 merge build/coverage.profraw -o build/coverage.profdata
	@llvm-cov-19 report build/tests-coverage -instr-profile=build/coverage.profdata -show-region-summary=false \
	  *.hpp wodtem.cpp data/*.hpp

bench: wodtem
	./wodtem bench

format:
	clang-format -i $(SOURCES)

clean:
	rm -rf build wodtem

.PHONY: packages run paper-gridworld test sanitize map mutants faults clang fuzz endure coverage bench format clean
