/* A loop that corrects by fresh readings, on a stage that is computed here: 2 % too stiff, 0.3 um off in a wave, two
 * samples late. Prints the mean error of each pass of a scan. Usage: corrected FILE.model.payload */
#include "dehyst.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#define PASSES 12
#define PASS 100 /* samples */

int main(int argc, char **argv) {
    FILE *file = argc == 2 ? fopen(argv[1], "rb") : NULL;
    uint8_t *payload = malloc(1 << 20);
    if (!file || !payload) {
        printf("usage: corrected FILE.model.payload\n");
        return 2;
    }
    size_t bytes = fread(payload, 1, 1 << 20, file);
    fclose(file);
    dehyst_limits limits = {0.0, 10.0, 2000.0, -40.0, 140.0};
    dehyst *stage = NULL;
    /* From the status of the service: share of the voltage range, lowest mode in Hz, time to let go in s. */
    dehyst_correction integral = {0.02, 180.0, 0.5}, repetition = {0.1, 180.0, 0.5};
    dehyst_report_t report;
    if (dehyst_open_payload(payload, bytes, &limits, &stage) || dehyst_correct(stage, &integral, &repetition) ||
        dehyst_report(stage, &report) || dehyst_period(stage, PASS * report.dt_s)) {
        printf("%s\n", dehyst_error());
        return 1;
    }
    double turn = 2.0 * acos(-1.0) / PASS, wanted_um[PASSES * PASS], read_um[PASSES * PASS], errors_um[PASSES] = {0};
    double added_V[2] = {0.0, 0.0};
    for (int64_t k = 0; k < PASSES * PASS; k++) {
        /* 1. What has been read since: here the sample before. Numbers pair readings with points. */
        int64_t seen = k - 1;
        int status = seen < 0 ? 0 : dehyst_read(stage, 1, &seen, &read_um[seen]);
        /* 2. The voltage of the next point. */
        double v = 20.0 * turn / report.dt_s * cos(turn * (double)k);
        dehyst_answer answer;
        dehyst_corrected_t corrected;
        wanted_um[k] = 45.0 + 20.0 * sin(turn * (double)k);
        status |= dehyst_number(stage, k) | dehyst_point(stage, wanted_um[k], v, 0.0, &answer);
        status |= dehyst_corrected(stage, 1, &corrected);
        if (status) {
            printf("%s\n", dehyst_error());
            return 1;
        }
        /* 3. Apply answer.u_V. The stage here follows what was added, and has an error of its own. */
        double off_um = 0.02 * (wanted_um[k] - 45.0) + 0.3 * sin(3.0 * turn * (double)k);
        read_um[k] = wanted_um[k] - off_um + 11.0 * added_V[0];
        added_V[0] = added_V[1];
        added_V[1] = corrected.integral.u_V + corrected.repetition.u_V;
        errors_um[k / PASS] += fabs(wanted_um[k] - read_um[k]) / PASS;
    }
    for (int i = 0; i < PASSES; i++)
        printf("pass %2d: mean error %.4f um\n", i + 1, errors_um[i]);
    dehyst_close(stage);
    free(payload);
    return errors_um[PASSES - 1] < 0.1 * errors_um[0] ? 0 : 1;
}
