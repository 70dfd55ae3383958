/* What processes, the machine and sockets used, from the kernel's books. */
#define _GNU_SOURCE
#include "load.h"

#include <dirent.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#ifndef SO_MEMINFO
#define SO_MEMINFO 55
#endif
enum { MEMINFO_DROPS = 8, MEMINFO_VARS = 9 }; /* linux/sock_diag.h */

/* A whole small file as a string; empty if it is gone. */
static const char *slurp(const char *path)
{
    static char text[16384];
    FILE *file = fopen(path, "r");
    size_t n = file ? fread(text, 1, sizeof text - 1, file) : 0;
    if (file)
        fclose(file);
    text[n] = 0;
    return text;
}

static uint64_t number_after(const char *text, const char *label)
{
    const char *at = strstr(text, label);
    return at ? strtoull(at + strlen(label), NULL, 10) : 0;
}

/* Run time of all threads, to the nanosecond; /proc/PID/stat counts in ticks. */
static void add_process(struct usage *sum, pid_t pid)
{
    char path[300];
    snprintf(path, sizeof path, "/proc/%d/task", (int)pid);
    DIR *tasks = opendir(path);
    if (!tasks)
        fail("a watched process is gone");
    for (struct dirent *task; (task = readdir(tasks));) {
        if (task->d_name[0] == '.')
            continue;
        snprintf(path, sizeof path, "/proc/%d/task/%s/schedstat", (int)pid, task->d_name);
        sum->cpu_ns += strtoull(slurp(path), NULL, 10);
        snprintf(path, sizeof path, "/proc/%d/task/%s/status", (int)pid, task->d_name);
        sum->switches += number_after(slurp(path), "\nvoluntary_ctxt_switches:");
    }
    closedir(tasks);
}

/* Of all processors: the time that they were not idle. */
static uint64_t machine_busy_ns(void)
{
    unsigned long long user, nice, system, idle, iowait;
    if (sscanf(slurp("/proc/stat"), "cpu %llu %llu %llu %llu %llu", &user, &nice, &system, &idle, &iowait) != 5)
        return 0;
    uint64_t tick_ns = (uint64_t)NS_PER_S / (uint64_t)sysconf(_SC_CLK_TCK);
    uint64_t all_ns = (uint64_t)now_ns() * (uint64_t)sysconf(_SC_NPROCESSORS_ONLN);
    return all_ns - (idle + iowait) * tick_ns;
}

struct usage usage_now(const struct options *set)
{
    struct usage sum = {0};
    for (size_t i = 0; i < set->watched_count; i++)
        add_process(&sum, set->watched[i]);
    struct timespec own;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &own);
    sum.own_cpu_ns = (uint64_t)(own.tv_sec * NS_PER_S + own.tv_nsec);
    sum.busy_ns = machine_busy_ns();
    return sum;
}

/* Frames that found our own receive buffer full: the load's fault, not the subject's. */
uint64_t socket_lost(int fd)
{
    uint32_t info[MEMINFO_VARS] = {0};
    socklen_t length = sizeof info;
    if (getsockopt(fd, SOL_SOCKET, SO_MEMINFO, info, &length) < 0)
        return 0;
    return info[MEMINFO_DROPS];
}
