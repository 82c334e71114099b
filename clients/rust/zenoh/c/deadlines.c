/* A loop at a steady rate that asks the followed model for one point each turn, and the same loop without it. Prints one
 * line of JSON: turns whose work was done only after the next turn was due, and the time of a point.
 * Usage: deadlines [WAYS] SECONDS RATE_HZ [ENDPOINT STAGE AXIS MODEL CENTRE_UM SWING_UM]; without an endpoint the loop
 * is bare. WAYS, by default none of them:
 * --receivers: the threads that receive models run only where nothing else does (Linux's idle class).
 * --realtime: the loop has a real-time priority, which needs the right, and those threads none.
 * --core: the loop has the last core, those threads have the others.
 * --warm: each turn begins 60 us early with dehyst_warm, so that caches and core are warm. */
#define _GNU_SOURCE
#include "dehyst_zenoh.h"

#include <math.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#define PI 3.14159265358979323846
#define WARM_US 60

static double since_us(struct timespec from, struct timespec to) {
    return 1e6 * (double)(to.tv_sec - from.tv_sec) + 1e-3 * (double)(to.tv_nsec - from.tv_nsec);
}

static int ascending(const void *a, const void *b) {
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

/* The class of the calling thread, which threads that it starts later inherit. */
static void schedule(int policy, int priority) {
    struct sched_param wanted = {.sched_priority = priority};
    if (sched_setscheduler(0, policy, &wanted)) {
        perror("deadlines: the scheduler's class");
        exit(1);
    }
}

/* The calling thread, and threads that it starts later, keep to the last core, or to all but the last. */
static void keep_to(int last) {
    long cores = sysconf(_SC_NPROCESSORS_ONLN);
    cpu_set_t wanted;
    CPU_ZERO(&wanted);
    for (long core = last ? cores - 1 : 0; core < (last ? cores : cores - 1); core++)
        CPU_SET((size_t)core, &wanted);
    if (sched_setaffinity(0, sizeof wanted, &wanted)) {
        perror("deadlines: cores");
        exit(1);
    }
}

static void sleep_until(struct timespec due, long less_us) {
    due.tv_nsec -= 1000 * less_us;
    if (due.tv_nsec < 0)
        due.tv_nsec += 1000000000L, due.tv_sec--;
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL);
}

int main(int argc, char **argv) {
    int receivers = 0, realtime = 0, core = 0, warm = 0, unknown = 0;
    for (; argc > 1 && !strncmp(argv[1], "--", 2); argc--, argv++) {
        int *way = !strcmp(argv[1], "--receivers") ? &receivers
                   : !strcmp(argv[1], "--realtime") ? &realtime
                   : !strcmp(argv[1], "--core")     ? &core
                   : !strcmp(argv[1], "--warm")     ? &warm
                                                    : &unknown;
        *way = 1;
    }
    double lasts_s = argc > 1 ? atof(argv[1]) : 0.0, rate_Hz = argc > 2 ? atof(argv[2]) : 0.0;
    long turns = lround(lasts_s * rate_Hz);
    double *point_us = turns > 0 ? malloc((size_t)turns * sizeof *point_us) : NULL;
    double *late_us = turns > 0 ? malloc((size_t)turns * sizeof *late_us) : NULL;
    if (unknown || (argc != 3 && argc != 9) || !point_us || !late_us) {
        printf("usage: deadlines [--receivers] [--realtime] [--core] [--warm] SECONDS RATE_HZ "
               "[ENDPOINT STAGE AXIS MODEL CENTRE_UM SWING_UM]\n");
        return 2;
    }
    dehyst *stage = NULL;
    double centre_um = 0.0, swing_um = 0.0, w = 4.0 * PI, period_us = 1e6 / rate_Hz;
    if (argc == 9) {
        if (receivers)
            schedule(SCHED_IDLE, 0);
        if (core)
            keep_to(0);
        if (dehyst_open(argv[3], argv[4], argv[5], argv[6], 20.0, &stage)) {
            fprintf(stderr, "%s\n", dehyst_error());
            return 1;
        }
        centre_um = atof(argv[7]), swing_um = atof(argv[8]);
    }
    if (receivers && stage)
        schedule(SCHED_OTHER, 0);
    if (realtime)
        schedule(SCHED_FIFO, 10);
    if (core)
        keep_to(1);
    long missed = 0, refused = 0;
    struct timespec due, start, end;
    clock_gettime(CLOCK_MONOTONIC, &due);
    for (long i = 0; i < turns; i++) {
        due.tv_nsec += lround(1e3 * period_us);
        while (due.tv_nsec >= 1000000000L)
            due.tv_nsec -= 1000000000L, due.tv_sec++;
        double phase = w * (double)i / rate_Hz, v_um_per_s = swing_um * w * cos(phase);
        double y_um = centre_um + swing_um * sin(phase), a_um_per_s2 = -swing_um * w * w * sin(phase);
        dehyst_answer answer;
        sleep_until(due, warm ? WARM_US : 0);
        if (warm) {
            if (stage)
                refused += dehyst_warm(stage, y_um, v_um_per_s, a_um_per_s2) != 0;
            do
                clock_gettime(CLOCK_MONOTONIC, &start);
            while (since_us(due, start) < 0.0);
        }
        clock_gettime(CLOCK_MONOTONIC, &start);
        if (stage)
            refused += dehyst_point(stage, y_um, v_um_per_s, a_um_per_s2, &answer) != 0;
        clock_gettime(CLOCK_MONOTONIC, &end);
        point_us[i] = since_us(start, end);
        late_us[i] = since_us(due, end);
        missed += late_us[i] > period_us;
    }
    unsigned long long models = 0;
    if (stage) {
        dehyst_report_t report;
        dehyst_report(stage, &report);
        models = report.received;
        dehyst_close(stage);
    }
    qsort(point_us, (size_t)turns, sizeof *point_us, ascending);
    qsort(late_us, (size_t)turns, sizeof *late_us, ascending);
    size_t p99 = (size_t)turns * 99 / 100, p999 = (size_t)turns * 999 / 1000;
    printf("{\"turns\": %ld, \"missed\": %ld, \"refused\": %ld, \"models\": %llu, \"point_us\": [%.2f, %.2f, %.2f], "
           "\"done_after_us\": [%.1f, %.1f, %.1f]}\n",
           turns, missed, refused, models, point_us[turns / 2], point_us[p99], point_us[p999], late_us[turns / 2],
           late_us[p99], late_us[p999]);
    free(point_us);
    free(late_us);
    return refused ? 1 : 0;
}
