// faults.c: a library for LD_PRELOAD that makes one call of a program fail. tests/faults.sh builds and uses it.
//   FAULT="CALL HOW N"  the N-th CALL (from 1; 0: none) fails as HOW says
//     CALL  open write fsync rename close read ftruncate unlink mkdir mmap thread malloc
//     HOW   the reason: EACCES EAGAIN EINTR EIO ENOMEM ENOSPC; FULL: ENOSPC, for every later CALL too; SHORT: half of
//           the bytes are read or written; TERM: nothing fails, but SIGTERM arrives
//   FAULT_COUNT=FILE    gets the number of CALLs when the program ends
// What is counted begins with the program's first call of signal(), the first act of wodtem: before it, and in libc's
// own calls (stdio, directories), nothing fails. A close() that fails has closed, as Linux's does.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

static const struct {
    const char* name;
    int number;
} reasons[] = {{"EACCES", EACCES}, {"EAGAIN", EAGAIN}, {"EINTR", EINTR}, {"EIO", EIO},
               {"ENOMEM", ENOMEM}, {"ENOSPC", ENOSPC}, {"FULL", ENOSPC}};

static char wanted_call[20], how[20];
static long wanted;  // which call fails
static atomic_long calls;
static atomic_int counting;

__attribute__((constructor)) static void begin(void) {
    const char* fault = getenv("FAULT");
    if (fault) sscanf(fault, "%19s %19s %ld", wanted_call, how, &wanted);
}

__attribute__((destructor)) static void end(void) {
    counting = 0;
    const char* path = getenv("FAULT_COUNT");
    FILE* file = path ? fopen(path, "w") : NULL;
    if (!file) return;
    fprintf(file, "%ld\n", atomic_load(&calls));
    fclose(file);
}

// Whether this call is the one: 1 with errno set; 0 otherwise. For SHORT 2.
static int fault(const char* call) {
    if (!counting || strcmp(call, wanted_call)) return 0;
    const long n = atomic_fetch_add(&calls, 1) + 1;
    if (wanted == 0 || n < wanted || (n > wanted && strcmp(how, "FULL"))) return 0;
    if (!strcmp(how, "SHORT")) return 2;
    if (!strcmp(how, "TERM")) raise(SIGTERM);
    for (size_t i = 0; i < sizeof reasons / sizeof *reasons; ++i)
        if (!strcmp(how, reasons[i].name)) return errno = reasons[i].number, 1;
    return 0;
}

#define REAL(name)                 \
    static __typeof__(&name) real; \
    if (!real) real = (__typeof__(&name))dlsym(RTLD_NEXT, #name)
#define WRAP(type, name, parameters, arguments, call, failed) \
    type name parameters {                                    \
        REAL(name);                                           \
        return fault(call) == 1 ? (failed) : real arguments;  \
    }

WRAP(int, fsync, (int fd), (fd), "fsync", -1)
WRAP(int, rename, (const char* from, const char* to), (from, to), "rename", -1)
WRAP(int, close, (int fd), (fd), "close", (real(fd), errno = EIO, -1))
WRAP(int, ftruncate, (int fd, off_t size), (fd, size), "ftruncate", -1)
WRAP(int, unlink, (const char* path), (path), "unlink", -1)
WRAP(int, remove, (const char* path), (path), "unlink", -1)
WRAP(int, mkdir, (const char* path, mode_t mode), (path, mode), "mkdir", -1)
WRAP(void*, mmap, (void* at, size_t size, int access, int flags, int fd, off_t offset),
     (at, size, access, flags, fd, offset), "mmap", MAP_FAILED)
WRAP(int, pthread_create, (pthread_t * thread, const pthread_attr_t* attributes, void* (*run)(void*), void* argument),
     (thread, attributes, run, argument), "thread", errno)

int open(const char* path, int flags, ...) {
    REAL(open);
    va_list list;
    va_start(list, flags);
    const mode_t mode = flags & O_CREAT ? va_arg(list, mode_t) : 0;
    va_end(list);
    return fault("open") == 1 ? -1 : real(path, flags, mode);
}

ssize_t write(int fd, const void* from, size_t size) {
    REAL(write);
    const int f = fault("write");
    return f == 1 ? -1 : real(fd, from, f == 2 && size > 1 ? size / 2 : size);
}

ssize_t read(int fd, void* to, size_t size) {
    REAL(read);
    const int f = fault("read");
    return f == 1 ? -1 : real(fd, to, f == 2 && size > 1 ? size / 2 : size);
}

ssize_t pread(int fd, void* to, size_t size, off_t at) {
    REAL(pread);
    const int f = fault("read");
    return f == 1 ? -1 : real(fd, to, f == 2 && size > 1 ? size / 2 : size, at);
}

sighandler_t signal(int number, sighandler_t handler) {
    REAL(signal);
    counting = 1;
    return real(number, handler);
}

// dlsym() allocates, so these go by glibc's second names.
extern void* __libc_malloc(size_t);
extern void* __libc_calloc(size_t, size_t);
extern void* __libc_realloc(void*, size_t);
extern void* __libc_memalign(size_t, size_t);
void* malloc(size_t size) { return fault("malloc") == 1 ? NULL : __libc_malloc(size); }
void* calloc(size_t count, size_t size) { return fault("malloc") == 1 ? NULL : __libc_calloc(count, size); }
void* realloc(void* old, size_t size) { return fault("malloc") == 1 ? NULL : __libc_realloc(old, size); }
void* aligned_alloc(size_t alignment, size_t size) {
    return fault("malloc") == 1 ? NULL : __libc_memalign(alignment, size);
}
