/* Two ends of a cycle that do nothing but read, copy and write: the least that a cycle can cost.

   frames DESCRIPTOR master CYCLES   SYNC, TPDO in, its data into an RPDO, RPDO out
   frames DESCRIPTOR drive CYCLES    waits for SYNC, TPDO out, RPDO in; to standard output as
                                     64-bit numbers: nanoseconds from TPDO to RPDO, each, and
                                     from the first SYNC to the last RPDO */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

struct frame {
    uint32_t id;
    uint8_t length, reserved[3], data[8];
};

static int64_t now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static void check(ssize_t size)
{
    if (size != sizeof(struct frame))
        exit(1);
}

static void master(int bus, long cycles)
{
    struct frame sync = {.id = 0x080}, tpdo, rpdo = {.id = 0x205, .length = 4};
    for (long j = 0; j < cycles; j++) {
        check(write(bus, &sync, sizeof sync));
        check(read(bus, &tpdo, sizeof tpdo));
        memcpy(rpdo.data, tpdo.data, 4);
        check(write(bus, &rpdo, sizeof rpdo));
    }
}

static void drive(int bus, long cycles)
{
    struct frame in, tpdo = {.id = 0x185, .length = 8, .data = {0, 0x10, 0, 0, 0x37, 0x02, 0, 0}};
    int64_t *took = calloc(cycles + 1, sizeof *took), first = 0;
    for (long j = 0; j < cycles; j++) {
        do
            check(read(bus, &in, sizeof in));
        while (in.id != 0x080);
        int64_t begin = now();
        first = j ? first : begin;
        check(write(bus, &tpdo, sizeof tpdo));
        check(read(bus, &in, sizeof in));
        took[j] = now() - begin;
        took[cycles] = begin + took[j] - first;
    }
    fwrite(took, sizeof *took, cycles + 1, stdout);
}

int main(int count, char **arguments)
{
    int bus = atoi(arguments[1]);
    long cycles = atol(arguments[3]);
    (arguments[2][0] == 'm' ? master : drive)(bus, cycles);
    return count != 4;
}
