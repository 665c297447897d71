// SPDX-License-Identifier: GPL-2.0
/* An spi_controller whose other end is the simulator, with a spidev child per chip select. */
#include <linux/list.h>
#include <linux/mm.h>
#include <linux/module.h>
#include <linux/slab.h>
#include <linux/spi/spi.h>

#include "bus.h"

#define CHIP_SELECTS 2           /* as many as a Raspberry Pi's spi0 */
#define MAX_SPEED_HZ 125000000   /* a Raspberry Pi's limit */

struct lab_spi {
	struct spi_controller *host;
	struct lab_bus *bus;
	struct list_head node;
};

static LIST_HEAD(buses);

static u32 delay_ns(struct spi_delay *delay, struct spi_transfer *transfer)
{
	int ns = spi_delay_to_ns(delay, transfer);

	return ns > 0 ? ns : 0;
}

static u8 *pack_transfer(u8 *to, struct spi_transfer *transfer)
{
	struct lab_spi_segment segment = {
		.length = transfer->len,
		.speed_hz = transfer->speed_hz,
		.delay_ns = delay_ns(&transfer->delay, transfer),
		.word_delay_ns = delay_ns(&transfer->word_delay, transfer),
		.cs_change_delay_ns = delay_ns(&transfer->cs_change_delay, transfer),
		.bits_per_word = transfer->bits_per_word,
		.cs_change = transfer->cs_change,
		.has_tx = !!transfer->tx_buf,
		.has_rx = !!transfer->rx_buf,
	};

	memcpy(to, &segment, sizeof(segment));
	to += sizeof(segment);
	if (transfer->tx_buf) {
		memcpy(to, transfer->tx_buf, transfer->len);
		to += transfer->len;
	}
	return to;
}

static struct lab_request *pack(struct spi_message *message)
{
	size_t size = sizeof(struct lab_request);
	struct spi_transfer *transfer;
	struct lab_request *request;
	u16 count = 0;
	u8 *to;

	list_for_each_entry(transfer, &message->transfers, transfer_list) {
		size += sizeof(struct lab_spi_segment) + (transfer->tx_buf ? transfer->len : 0);
		count++;
	}
	if (size > LAB_MAX_BYTES)
		return ERR_PTR(-EMSGSIZE);
	request = kvzalloc(size, GFP_KERNEL);
	if (!request)
		return ERR_PTR(-ENOMEM);
	request->size = size;
	request->kind = LAB_KIND_SPI;
	request->segments = count;
	request->mode = message->spi->mode & SPI_MODE_USER_MASK;
	request->chip_select = spi_get_chipselect(message->spi, 0);
	to = (u8 *)(request + 1);
	list_for_each_entry(transfer, &message->transfers, transfer_list)
		to = pack_transfer(to, transfer);
	return request;
}

static void unpack(const struct lab_answer *answer, struct spi_message *message)
{
	const u8 *from = lab_answer_data(answer);
	struct spi_transfer *transfer;

	list_for_each_entry(transfer, &message->transfers, transfer_list)
		if (transfer->rx_buf)
			from = lab_answer_take(answer, from, transfer->rx_buf, transfer->len);
}

static int exchange(struct lab_spi *spi, struct spi_message *message)
{
	struct lab_request *request = pack(message);
	u32 read_bytes = 0, all_bytes = 0;
	struct spi_transfer *transfer;
	struct lab_answer *answer;
	int status;

	if (IS_ERR(request))
		return PTR_ERR(request);
	list_for_each_entry(transfer, &message->transfers, transfer_list) {
		all_bytes += transfer->len;
		read_bytes += transfer->rx_buf ? transfer->len : 0;
	}
	answer = lab_bus_exchange(spi->bus, request, all_bytes, read_bytes);
	kvfree(request);
	if (IS_ERR(answer))
		return PTR_ERR(answer);
	unpack(answer, message);
	message->actual_length = answer->done;
	status = answer->status;
	kvfree(answer);
	return status;
}

static int lab_spi_message(struct spi_controller *host, struct spi_message *message)
{
	struct lab_spi **spi = spi_controller_get_devdata(host);

	message->status = exchange(*spi, message);
	spi_finalize_current_message(host);
	return message->status;
}

static int add_children(struct spi_controller *host)
{
	for (int chip_select = 0; chip_select < CHIP_SELECTS; chip_select++) {
		struct spi_board_info info = {
			.modalias = "spi-authenta", /* one of the names spidev binds to */
			.max_speed_hz = MAX_SPEED_HZ,
			.chip_select = chip_select,
		};

		if (!spi_new_device(host, &info))
			return -ENODEV;
	}
	return 0;
}

int lab_spi_create(struct device *parent, int number, unsigned int word_bits)
{
	struct lab_spi *spi;
	int result = -ENOMEM;

	if (word_bits != 8 && word_bits != 16)
		return -EINVAL;
	spi = kzalloc(sizeof(*spi), GFP_KERNEL);
	if (!spi)
		return -ENOMEM;
	spi->host = spi_alloc_host(parent, sizeof(struct lab_spi *));
	if (!spi->host)
		goto no_host;
	spi->bus = lab_bus_create(parent, "spi", number);
	if (IS_ERR(spi->bus)) {
		result = PTR_ERR(spi->bus);
		goto no_bus;
	}
	*(struct lab_spi **)spi_controller_get_devdata(spi->host) = spi;
	spi->host->bus_num = number;
	spi->host->num_chipselect = CHIP_SELECTS;
	spi->host->mode_bits = SPI_CPOL | SPI_CPHA | SPI_CS_HIGH | SPI_NO_CS;
	spi->host->bits_per_word_mask = SPI_BPW_MASK(8) | (word_bits == 16 ? SPI_BPW_MASK(16) : 0);
	spi->host->max_speed_hz = MAX_SPEED_HZ;
	spi->host->transfer_one_message = lab_spi_message;
	result = spi_register_controller(spi->host);
	if (result)
		goto no_controller;
	list_add(&spi->node, &buses);
	return add_children(spi->host); /* on failure the caller destroys all */

no_controller:
	lab_bus_destroy(spi->bus);
no_bus:
	spi_controller_put(spi->host);
no_host:
	kfree(spi);
	return result;
}

void lab_spi_destroy_all(void)
{
	struct lab_spi *spi, *next;

	list_for_each_entry_safe(spi, next, &buses, node) {
		spi_unregister_controller(spi->host); /* drops the last reference, children included */
		lab_bus_destroy(spi->bus);
		kfree(spi);
	}
}
