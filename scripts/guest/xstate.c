/* User-mode Linux on a host with AMX: loaded before its C library (LD_PRELOAD).
 *
 * Debian 12's restores 2696 bytes of registers of a process, all up to those of AMX, and its host
 * takes nothing but the whole. AMX, which a process has to ask for first, stays as it is at first.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/types.h>
#include <sys/uio.h>

typedef long ptrace_function(enum __ptrace_request, pid_t, void *, void *);

long ptrace(enum __ptrace_request request, ...)
{
    static ptrace_function *of_the_library;
    static char state[1 << 16] __attribute__((aligned(64)));
    va_list rest;

    va_start(rest, request);
    pid_t pid = va_arg(rest, pid_t);
    void *address = va_arg(rest, void *);
    void *data = va_arg(rest, void *);
    va_end(rest);
    if (!of_the_library)
        of_the_library = (ptrace_function *)dlsym(RTLD_NEXT, "ptrace");
    if (request == PTRACE_SETREGSET && (unsigned long)address == NT_X86_XSTATE) {
        struct iovec *given = data, whole = {state, sizeof state};
        if (of_the_library(PTRACE_GETREGSET, pid, address, &whole) < 0)
            return -1;
        if (given->iov_len < whole.iov_len) {
            memcpy(state, given->iov_base, given->iov_len);
            memset(state + given->iov_len, 0, whole.iov_len - given->iov_len);
            return of_the_library(request, pid, address, &whole);
        }
    }
    return of_the_library(request, pid, address, data);
}
