/* A stage on the wire: takes the command blocks of a controller, applies one voltage each millisecond, and publishes
 * what its sensor reads, five samples a message. In place of hardware it has a gain and one play. Its clock starts with
 * the command for sample 0. Usage: stage ENDPOINT STAGE AXIS SECONDS. For little-endian processors, as the wire is. */
#include "dehyst_zenoh.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define BATCH 5
#define AHEAD 8192 /* samples that a command may be ahead */
#define DT_S 1e-3

static double now_s(void) {
    struct timespec at;
    clock_gettime(CLOCK_MONOTONIC, &at);
    return (double)at.tv_sec + 1e-9 * (double)at.tv_nsec;
}

static double planned[AHEAD]; /* by number modulo AHEAD; NaN: none */

/* Take a payload of kind 2. Returns whether it is one, and its first number. */
static int command(const uint8_t *data, size_t bytes, int64_t k, int64_t *first) {
    uint32_t n;
    if (bytes < 16 || memcmp(data, "\1\2\0\0", 4))
        return 0;
    memcpy(&n, data + 4, 4), memcpy(first, data + 8, 8);
    if (n > AHEAD || bytes != 16 + 8 * (size_t)n || *first < 0 || *first + n > k + AHEAD)
        return 0;
    for (uint32_t i = 0; i < n; i++)
        if (*first + i >= k)
            memcpy(&planned[(*first + i) % AHEAD], data + 16 + 8 * i, 8);
    return 1;
}

int main(int argc, char **argv) {
    static uint8_t block[16 + 8 * AHEAD];
    dehyst_link *link = NULL;
    if (argc != 5) {
        printf("usage: stage ENDPOINT STAGE AXIS SECONDS\n");
        return 2;
    }
    if (dehyst_link_open(argv[1], argv[2], argv[3], "command", 5.0, &link)) {
        fprintf(stderr, "%s\n", dehyst_error());
        return 1;
    }
    for (int i = 0; i < AHEAD; i++)
        planned[i] = NAN;
    int64_t last = llround(atof(argv[4]) / DT_S), k = 0, first = -1, seq[BATCH];
    double begin_s = -1.0, u_V = 0.0, play = 0.0, t_s[BATCH], u[BATCH], y[BATCH];
    long missing = 0, refused = 0;
    size_t rows = 0;
    printf("ready\n");
    fflush(stdout);
    while (k < last) {
        size_t bytes = 0;
        double wait_s = begin_s < 0.0 ? 0.05 : fmax(0.0, begin_s + (double)k * DT_S - now_s());
        if (dehyst_link_receive(link, wait_s, block, sizeof block, &bytes) ||
            (bytes && !command(block, bytes, k, &first)))
            refused++;
        if (begin_s < 0.0 && first == 0)
            begin_s = now_s();
        if (bytes || begin_s < 0.0)
            continue;
        seq[rows] = k, t_s[rows] = (double)k * DT_S, y[rows] = 1.0 + 8.4 * u_V + 2.0 * play;
        double next_V = planned[k % AHEAD];
        planned[k % AHEAD] = NAN;
        if (isfinite(next_V))
            u_V = next_V, play = fmax(u_V - 1.0, fmin(u_V + 1.0, play));
        else
            missing++;
        u[rows++] = u_V, k++;
        if (rows == BATCH || k == last) {
            refused += dehyst_samples(link, rows, seq, t_s, u, y) != 0;
            rows = 0;
        }
    }
    printf("%lld samples, %ld voltages missing, %ld commands refused\n", (long long)last, missing, refused);
    dehyst_link_close(link);
    return 0;
}
