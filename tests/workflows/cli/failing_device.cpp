// A device that fails in the middle of a command, put before the C library by LD_PRELOAD.
//
// DEVICE_FOLDER: files below it are on the device, with DEVICE_NAME only those with it in their path. DEVICE_CALLS: calls that fail, as "read,write". DEVICE_AFTER: how
// many of them succeed first. DEVICE_ERROR: the number of the error. "mmap" among the calls gives a map without bytes,
// as of a device whose pages cannot be read: a look into it ends the process by SIGBUS.
// DEVICE_CLOCK: s by which the clock is set back once that many calls were made on the device.
#include <cerrno>
#include <cstdarg>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <dlfcn.h>
#include <fcntl.h>
#include <sys/mman.h>
#include <unistd.h>

#include <atomic>

static std::atomic<long> calls{0};

static bool on_device(const char *path) {
    const char *folder = getenv("DEVICE_FOLDER");
    const char *name = getenv("DEVICE_NAME");
    return folder && path && !strncmp(path, folder, strlen(folder)) && (!name || strstr(path, name));
}

static bool on_device(int file) {
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = readlink(link, path, sizeof path - 1);
    path[length < 0 ? 0 : length] = 0;
    return on_device(path);
}

static bool is_over() {
    const char *after = getenv("DEVICE_AFTER");
    return calls++ >= (after ? atol(after) : 0);
}

static bool fails(const char *call) {
    const char *named = getenv("DEVICE_CALLS");
    const char *found = named ? strstr(named, call) : nullptr;
    if (!found || !is_over()) return false;
    errno = atoi(getenv("DEVICE_ERROR"));
    return true;
}

#define REAL(name) static auto real = reinterpret_cast<decltype(&name)>(dlsym(RTLD_NEXT, #name))

#define OPEN(name)                                              \
    extern "C" int name(const char *path, int flags, ...) {     \
        REAL(name);                                             \
        va_list more;                                           \
        va_start(more, flags);                                  \
        mode_t mode = va_arg(more, mode_t);                     \
        va_end(more);                                           \
        if (on_device(path) && fails("open")) return -1;        \
        return real(path, flags, mode);                         \
    }
OPEN(open)
OPEN(open64)

extern "C" ssize_t read(int file, void *into, size_t size) {
    REAL(read);
    return on_device(file) && fails("read") ? -1 : real(file, into, size);
}
extern "C" ssize_t pread(int file, void *into, size_t size, off_t at) {
    REAL(pread);
    return on_device(file) && fails("read") ? -1 : real(file, into, size, at);
}
extern "C" ssize_t pread64(int file, void *into, size_t size, off64_t at) {
    REAL(pread64);
    return on_device(file) && fails("read") ? -1 : real(file, into, size, at);
}
extern "C" ssize_t write(int file, const void *from, size_t size) {
    REAL(write);
    return on_device(file) && fails("write") ? -1 : real(file, from, size);
}
extern "C" int fsync(int file) {
    REAL(fsync);
    return on_device(file) && fails("fsync") ? -1 : real(file);
}
extern "C" int rename(const char *from, const char *to) {
    REAL(rename);
    return on_device(to) && fails("rename") ? -1 : real(from, to);
}
extern "C" int link(const char *from, const char *to) {
    REAL(link);
    return on_device(to) && fails("link") ? -1 : real(from, to);
}

#define MAP(name, offset)                                                                         \
    extern "C" void *name(void *at, size_t size, int access, int flags, int file, offset begin) { \
        REAL(name);                                                                               \
        if (file >= 0 && on_device(file) && fails("mmap")) {                                      \
            int empty = memfd_create("empty", 0);                                                 \
            return real(at, size, access, flags, empty, 0);                                       \
        }                                                                                         \
        return real(at, size, access, flags, file, begin);                                        \
    }
MAP(mmap, off_t)
MAP(mmap64, off64_t)

extern "C" int clock_gettime(clockid_t clock, struct timespec *now) {
    REAL(clock_gettime);
    int done = real(clock, now);
    const char *back = getenv("DEVICE_CLOCK"), *after = getenv("DEVICE_AFTER");
    if (back && clock == CLOCK_REALTIME && calls >= atol(after)) now->tv_sec -= atol(back);
    return done;
}
