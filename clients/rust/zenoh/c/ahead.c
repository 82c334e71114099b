/* A controller that asks the service ahead of time and commands a stage: a 2 Hz sine in blocks of 20 samples, each
 * asked for 60 samples ahead, with what is under way (docs/protocol.md). It starts the count of its stage with sample 0.
 * Usage: ahead ENDPOINT STAGE AXIS SECONDS CENTRE_UM SWING_UM. For little-endian processors, as the wire is. */
#include "dehyst_zenoh.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define PI 3.14159265358979323846
#define BLOCK 20
#define LEAD 60
#define KEPT 1000 /* samples under way that are sent: more than can be, the service leaves out what it has seen */

static double now_s(void) {
    struct timespec at;
    clock_gettime(CLOCK_MONOTONIC, &at);
    return (double)at.tv_sec + 1e-9 * (double)at.tv_nsec;
}

/* Append to a payload. */
static void put(uint8_t **at, const void *what, size_t bytes) {
    memcpy(*at, what, bytes);
    *at += bytes;
}

int main(int argc, char **argv) {
    static uint8_t query[64 + 24 * BLOCK + 16 * KEPT], reply[65536], block[16 + 8 * BLOCK];
    dehyst *model = NULL;
    dehyst_link *link = NULL;
    dehyst_report_t report;
    if (argc != 7) {
        printf("usage: ahead ENDPOINT STAGE AXIS SECONDS CENTRE_UM SWING_UM\n");
        return 2;
    }
    /* The sample time; a controller that follows the model would keep this handle. */
    if (dehyst_open(argv[1], argv[2], argv[3], "", 5.0, &model) ||
        dehyst_link_open(argv[1], argv[2], argv[3], NULL, 1.0, &link)) {
        fprintf(stderr, "%s\n", dehyst_error());
        return 1;
    }
    dehyst_report(model, &report);
    dehyst_close(model);
    double dt_s = report.dt_s, centre_um = atof(argv[5]), swing_um = atof(argv[6]), w = 4.0 * PI;
    int64_t end = llround(atof(argv[4]) / dt_s) / BLOCK * BLOCK, newest = -1;
    double *y_um = calloc((size_t)end + BLOCK, sizeof *y_um), *u_V = calloc((size_t)end + BLOCK, sizeof *u_V);
    double begin_s = now_s();
    long late = 0;
    for (int64_t first = 0; y_um && u_V && first < end; first += BLOCK) {
        double pause_s = begin_s + (double)(first > LEAD ? first - LEAD : 0) * dt_s - now_s();
        if (pause_s > 0.0)
            nanosleep(&(struct timespec){(time_t)pause_s, (long)(1e9 * (pause_s - floor(pause_s)))}, NULL);
        double v[BLOCK], a[BLOCK], before_V = first ? u_V[first - 1] : NAN;
        for (int i = 0; i < BLOCK; i++) { /* from the bottom at rest */
            double t_s = (double)(first + i) * dt_s;
            y_um[first + i] = centre_um - swing_um * cos(w * t_s);
            v[i] = swing_um * w * sin(w * t_s), a[i] = swing_um * w * w * cos(w * t_s);
        }
        int64_t begin = first > KEPT ? first - KEPT : 0;
        uint32_t n = BLOCK, k = (uint32_t)(first - begin), none[2] = {0, 0};
        uint8_t *at = query, kind[4] = {1, 4, k ? 5 : 1, 0}; /* accelerations; what is under way */
        put(&at, kind, 4), put(&at, &n, 4), put(&at, &newest, 8), put(&at, &before_V, 8), put(&at, none, 8);
        put(&at, y_um + first, sizeof v), put(&at, v, sizeof v), put(&at, a, sizeof a);
        if (k)
            put(&at, &begin, 8), put(&at, &k, 4), put(&at, y_um + begin, 8 * k), put(&at, u_V + begin, 8 * k);
        size_t bytes = 0;
        if (dehyst_link_ask(link, "feedforward", query, (size_t)(at - query), reply, sizeof reply, &bytes)) {
            fprintf(stderr, "%s\n", dehyst_error());
            return 1;
        }
        if (bytes < 24 + 16 * BLOCK || memcmp(reply, "\1\5", 2) || memcmp(reply + 4, &n, 4)) {
            fprintf(stderr, "not a reply for %d points\n", BLOCK);
            return 1;
        }
        memcpy(u_V + first, reply + 24, sizeof v);
        at = block;
        put(&at, "\1\2\0\0", 4), put(&at, &n, 4), put(&at, &first, 8), put(&at, u_V + first, sizeof v);
        if (dehyst_link_send(link, "command", block, sizeof block)) {
            fprintf(stderr, "%s\n", dehyst_error());
            return 1;
        }
        if (!first)
            begin_s = now_s(); /* the stage's clock starts with the first block */
        else
            late += now_s() > begin_s + (double)first * dt_s;
    }
    printf("%lld voltages, %ld blocks late, last %.4f V\n", (long long)end, late, end && u_V ? u_V[end - 1] : NAN);
    dehyst_link_close(link);
    free(y_um), free(u_V);
    return 0;
}
