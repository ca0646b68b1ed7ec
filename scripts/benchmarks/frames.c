/* Two ends of a cycle that do nothing but read, copy and write: the least that a cycle can cost.

   frames DESCRIPTOR master CYCLES [awake]   SYNC, TPDO in, its data into an RPDO, RPDO out
   frames DESCRIPTOR drive CYCLES [awake]    waits for SYNC, TPDO out, RPDO in; to standard output
     as 64-bit numbers: nanoseconds from TPDO to RPDO and from each SYNC to the next
   It waits in recv, or awake: it looks for a frame again and again. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>

struct frame { uint32_t id; uint8_t length, reserved[3], data[8]; };
static int bus, flags;
static int64_t now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static void put(const struct frame *f)
{
    if (send(bus, f, sizeof *f, 0) != sizeof *f) exit(1);
}

static void take(struct frame *f)
{
    ssize_t size;
    while ((size = recv(bus, f, sizeof *f, flags)) < 0 && flags);
    if (size != sizeof *f) exit(1);
}

static void master(long cycles)
{
    struct frame sync = {.id = 0x080}, tpdo, rpdo = {.id = 0x205, .length = 4};
    for (long j = 0; j < cycles; j++)
        put(&sync), take(&tpdo), memcpy(rpdo.data, tpdo.data, 4), put(&rpdo);
}

static void drive(long cycles)
{
    struct frame in, tpdo = {.id = 0x185, .length = 8, .data = {0, 0x10, 0, 0, 0x37, 0x02, 0, 0}};
    int64_t *took = calloc(2 * cycles, sizeof *took), before = 0;
    for (long j = 0; j < cycles; j++, took += 2) {
        do take(&in); while (in.id != 0x080);
        int64_t begin = now();
        put(&tpdo), take(&in);
        took[0] = now() - begin, took[1] = begin - before, before = begin;
    }
    fwrite(took - 2 * cycles, sizeof *took, 2 * cycles, stdout);
}

int main(int count, char **arguments)
{
    bus = atoi(arguments[1]), flags = count > 4 ? MSG_DONTWAIT : 0;
    (arguments[2][0] == 'm' ? master : drive)(atol(arguments[3]));
}
