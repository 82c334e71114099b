/* A controller in C that follows the model of a service: asks one point each sample time, commands nothing, and prints
 * what it would have commanded. Usage: controller ENDPOINT STAGE AXIS MODEL SECONDS CENTRE_UM SWING_UM */
#include "dehyst_zenoh.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#define PI 3.14159265358979323846

static double seconds(struct timespec at) {
    return (double)at.tv_sec + 1e-9 * (double)at.tv_nsec;
}

int main(int argc, char **argv) {
    if (argc != 8) {
        printf("usage: controller ENDPOINT STAGE AXIS MODEL SECONDS CENTRE_UM SWING_UM\n");
        return 2;
    }
    dehyst *stage = NULL;
    if (dehyst_open(argv[1], argv[2], argv[3], argv[4], 5.0, &stage)) {
        fprintf(stderr, "%s\n", dehyst_error());
        return 1;
    }
    double lasts_s = atof(argv[5]), centre_um = atof(argv[6]), swing_um = atof(argv[7]), w = 4.0 * PI;
    dehyst_report_t report;
    dehyst_report(stage, &report);
    double dt_s = report.dt_s, slowest_s = 0.0;
    long points = lround(lasts_s / dt_s), late = 0, refused = 0, flagged = 0;
    struct timespec next, start, end;
    clock_gettime(CLOCK_MONOTONIC, &next);
    for (long i = 0; i < points; i++) {
        next.tv_nsec += lround(dt_s * 1e9);
        while (next.tv_nsec >= 1000000000L)
            next.tv_nsec -= 1000000000L, next.tv_sec++;
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &next, NULL);
        double t_s = (double)i * dt_s;
        dehyst_answer answer;
        clock_gettime(CLOCK_MONOTONIC, &start);
        int status = dehyst_point(stage, centre_um + swing_um * sin(w * t_s), swing_um * w * cos(w * t_s),
                                  -swing_um * w * w * sin(w * t_s), &answer);
        clock_gettime(CLOCK_MONOTONIC, &end);
        refused += status != 0;
        flagged += status == 0 && answer.flags != 0;
        late += seconds(end) - seconds(next) > dt_s;
        slowest_s = fmax(slowest_s, seconds(end) - seconds(start));
    }
    dehyst_report(stage, &report);
    printf("%ld points, %ld refused, %ld flagged, %ld late by more than a sample, slowest %.1f us, last %.6f V from %s, "
           "sample %lld, gain %.4f, %llu models\n",
           points, refused, flagged, late, 1e6 * slowest_s, report.last.u_V, report.source,
           (long long)report.snapshot_seq, report.gain, (unsigned long long)report.received);
    dehyst_close(stage);
    return refused ? 1 : 0;
}
