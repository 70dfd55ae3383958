/* Counts what holds and prints what does not, with its place; every test program ends with checks_end(). */
#ifndef CAN_BRIDGE_CHECK_H
#define CAN_BRIDGE_CHECK_H

#include <stdarg.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>

#define LENGTH(array) (sizeof(array) / sizeof *(array))
#define CHECK(condition) check(condition, __FILE__, __LINE__, #condition)

static unsigned passed, failed;

__attribute__((format(printf, 3, 4))) static inline void fail(const char *file, int line, const char *format, ...)
{
    va_list args;

    failed++;
    printf("%s:%d: ", file, line);
    va_start(args, format);
    vprintf(format, args);
    va_end(args);
    putchar('\n');
}

static inline void check(bool good, const char *file, int line, const char *condition)
{
    if (good)
        passed++;
    else
        fail(file, line, "%s", condition);
}

/* The last line of the output, and the exit status. */
static inline int checks_end(void)
{
    printf("%u passed, %u failed\n", passed, failed);
    return failed ? EXIT_FAILURE : EXIT_SUCCESS;
}

#endif
